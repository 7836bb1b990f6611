"""A model as pages of filters see it, and how its equations change along a parameter.

A parameter moves the mean by dx and the constants by dc, and so

    df = F dx + f_c dc,   dF = F_x dx + F_c dc

Where the model's functions can be traced, all of it follows from their graphs. Others are called, and what is
not known of them is found by central differences (`differences`).
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from typing import Self

from filters.algebra.matrices import Matrix, Operation, never, plus, through
from filters.algebra.points import root
from filters.pages.at_points import called_at_points
from filters.pages.differences import called_parts
from filters.pages.memory import NumbersMemory
from filters.pages.traced import not_known, traced_model
from thruster_env.model.shape import Functions


class PagedModel:
    """What pages find in a model besides its equations f, F, h and H.

    Attributes:
        Q, R: its covariances; Q of a model with a step ratio is that of the step's length.
        Q_root, R_root, prior_root: lower triangular roots of Q, R and the prior covariance.
        prior_mean: of the state.
        own: the filter's parameters.
        kept: what the filter keeps besides mean and covariance, by name.
        state_angles, measurement_angles: flags of components that are angles.
    """

    def __init__(self, memory: NumbersMemory):
        """Take where the model's numbers lie."""
        shape, self._constants = memory.shape, memory.constants
        self.state_angles, self.measurement_angles = shape.state_angles, shape.measurement_angles
        self.Q, self.R, self.Q_root, self.R_root = memory.Q, memory.R, memory.Q_root, memory.R_root
        if shape.step_ratio and memory.ratio is not None:
            self.Q = memory.Q * memory.ratio
            self.Q_root = root(self.Q)
        self.prior_mean, self.prior_root = memory.prior_mean, memory.prior_root
        self.own, self.kept = memory.own, memory.kept

    def at(self, constants: Matrix) -> Self:
        """The same model with other constants."""
        other = copy(self)
        other._constants = constants
        return other


class Equations(PagedModel):
    """A model whose functions take Matrices.

    Attributes:
        called: if functions are to be called, those that work out the model's operations.
    """

    def __init__(
        self,
        functions: Functions,
        memory: NumbersMemory,
        *,
        constants_move: bool,
        trace: bool,
        partly: bool = False,
    ):
        """Take the model's functions, where its numbers lie, and whether parameters move its constants.

        They are traced, or to be called. If they are traced `partly`, what needs one that cannot be traced raises
        TypeError when it is worked out; else that is raised here.
        """
        shape = memory.shape
        super().__init__(memory)
        self._scales = memory.scales
        self._moves = (memory.constants_slope, memory.size) if constants_move and shape.constants else ()
        self.called: dict[Operation, Callable] = {}
        chosen = functions, shape
        parts: list[tuple[Callable, ...]]
        if trace:
            traced = traced_model(functions, shape, partly)
            parts = [one.parts for one in traced]
            self._parts_at_points: Callable = lambda which, points: traced[which == "sight"].of_points
        else:
            parts = [called_parts(*chosen, which, bool(self._moves)) for which in ("motion", "sight")]
            self._parts_at_points = lambda which, points: called_at_points(
                *chosen, which, bool(self._moves), points
            )
        self._f, self._F = self._operations("f", parts[0], shape.n, shape.n, trace)
        self._h, self._H = self._operations("h", parts[1], shape.m, shape.n, trace)
        self._traced, self._rows = trace, {"motion": shape.n, "sight": shape.m}
        self._of_points: dict[tuple[str, int], Operation] = {}

    def f(self, x: Matrix, u: Matrix) -> Matrix:
        """The state, a substep after x; of points (n, points) that of each."""
        return (self._f if len(x.shape) == 1 else self._at_points("motion", x))(x, u, self._constants)

    def F(self, x: Matrix, u: Matrix) -> Matrix:  # noqa: N802
        """df/dx."""
        return self._F(x, self._scales, u, self._constants)

    def h(self, x: Matrix) -> Matrix:
        """What is measured at x; of points (n, points) at each."""
        return (self._h if len(x.shape) == 1 else self._at_points("sight", x))(x, self._constants)

    def H(self, x: Matrix) -> Matrix:  # noqa: N802
        """dh/dx."""
        return self._H(x, self._scales, self._constants)

    def _operations(
        self, name: str, parts: tuple[Callable, ...], rows: int, n: int, trace: bool
    ) -> tuple[Operation, Operation]:
        """An equation (x, ..., c) and its Jacobian (x, scales, ..., c); their derivatives are operations, too."""
        shapes = (rows,), (rows, n), (rows,), (rows, n), (n, rows, n), (rows, n)
        made = [
            Operation(part if trace else not_known, lambda *_, shape=shape: shape, never)
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
            return plus(moved, by_constants(x, self._scales, *others, *self._moves) if self._moves else None)

        @matrix.derivative
        def of_matrix(result, arguments, slopes):
            if curved:
                curvature, contraction = curved
                return contraction(curvature(*arguments), slopes[0])
            return slope(*arguments, slopes[0], *self._moves)

        return value, matrix

    def _at_points(self, which: str, x: Matrix) -> Operation:
        """An equation (X, ..., c) of each column of X; its slope (X, scales, ..., c, dX) is an operation, too."""
        key = which, x.shape[1]
        if key in self._of_points:
            return self._of_points[key]
        parts, rows = self._parts_at_points(*key), self._rows[which]
        value, slope = (
            Operation(part if self._traced else not_known, lambda x, *_: (rows, x[1]), never) for part in parts
        )
        value.name, slope.name = f"{which}_of_points", f"d_{which}_of_points"
        self._of_points[key] = value
        if not self._traced:
            self.called |= {value: parts[0], slope: parts[1]}

        @value.derivative
        def of_value(result, arguments, slopes):
            x, *others = arguments
            return slope(x, self._scales, *others, slopes[0], *self._moves)

        return value
