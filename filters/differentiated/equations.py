"""A model as pages of filters see it, and how its equations change along a parameter.

A parameter moves the mean by dx and the constants by dc, and so

    df = F dx + f_c dc,   dF = F_x dx + F_c dc

Where the model's functions can be traced, all of it follows from their graphs. Others are called, and what is
not known of them is found by central differences (`differences`).
"""

from __future__ import annotations

from collections.abc import Callable

from filters.differentiated.differences import called_parts
from filters.differentiated.memory import Memory
from filters.differentiated.traced import Traced
from numerics.algebra.matrices import Matrix, Operation, never, plus, through
from plants.shape import Functions


class Equations:
    """A model whose functions take Matrices.

    Attributes:
        Q, R: its covariances.
        state_angles, measurement_angles: flags of components that are angles.
        called: if functions are to be called, those that work out the model's operations.
    """

    def __init__(self, functions: Functions, memory: Memory, *, constants_move: bool, trace: bool):
        """Take the model's functions, where its numbers lie, and whether parameters move its constants."""
        shape, f, by_f, h, by_h = memory.shape, *functions
        self.state_angles, self.measurement_angles = shape.state_angles, shape.measurement_angles
        self.Q, self.R, self._scales, self._constants = memory.Q, memory.R, memory.scales, memory.constants
        self._moves = (memory.constants_slope, memory.size) if constants_move and shape.constants else ()
        self.called: dict[Operation, Callable] = {}
        motion: tuple[Callable, ...]
        sight: tuple[Callable, ...]
        if trace:
            motion, sight = Traced(f, by_f, 2, shape).parts, Traced(h, by_h, 1, shape).parts
        else:
            motion, sight = (
                called_parts(functions, shape, which, bool(self._moves)) for which in ("motion", "sight")
            )
        self._motion = self._operations("f", motion, shape.n, shape.n, trace)
        self._sight = self._operations("h", sight, shape.m, shape.n, trace)

    def f(self, x: Matrix, u: Matrix) -> Matrix:
        """The state, a substep after x."""
        return self._motion[0](x, u, self._constants)

    def F(self, x: Matrix, u: Matrix) -> Matrix:  # noqa: N802
        """df/dx."""
        return self._motion[1](x, self._scales, u, self._constants)

    def h(self, x: Matrix) -> Matrix:
        """What is measured at x."""
        return self._sight[0](x, self._constants)

    def H(self, x: Matrix) -> Matrix:  # noqa: N802
        """dh/dx."""
        return self._sight[1](x, self._scales, self._constants)

    def _operations(
        self, name: str, parts: tuple[Callable, ...], rows: int, n: int, trace: bool
    ) -> tuple[Operation, Operation]:
        """An equation (x, ..., c) and its Jacobian (x, scales, ..., c); their derivatives are operations, too."""
        shapes = (rows,), (rows, n), (rows,), (rows, n), (n, rows, n), (rows, n)
        made = [
            Operation(part if trace else _not_known, lambda *_, shape=shape: shape, never)
            for part, shape in zip(parts, shapes, strict=False)
        ]
        value, matrix, by_constants, slope, *curved = made
        value.name, matrix.name, by_constants.name, slope.name = (
            name,
            name.upper(),
            f"{name}_c",
            f"d{name.upper()}",
        )
        if not trace:
            self.called |= dict(zip(made, parts, strict=True))

        @value.derivative
        def of_value(result, arguments, slopes):
            x, *others = arguments
            moved = through(lambda dx: matrix(x, self._scales, *others) @ dx, slopes[0])
            return plus(moved, by_constants(*arguments, *self._moves) if self._moves else None)

        @matrix.derivative
        def of_matrix(result, arguments, slopes):
            if curved:
                curvature, contraction = curved
                return contraction(curvature(*arguments), slopes[0])
            return slope(*arguments, slopes[0], *self._moves)

        return value, matrix


def _not_known(*arguments):
    raise TypeError("a function that is called computes nothing of numbers that are not known yet")
