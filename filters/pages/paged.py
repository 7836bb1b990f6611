"""A page for a model, as graphs of matrices: what its functions make of a belief, an input and a measurement.

`filters.tensors` works such graphs out of tensors, `filters.c` writes them as C.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from filters.pages.page import Page
from numerics.algebra.matrices import Matrix, Operation, given, never
from plants.shape import Shape


class Equation(Protocol):
    """An equation of a model, y = f(x, u, c) or h(x, c), of whatever stands in the places of matrices."""

    @property
    def with_jacobian(self) -> Callable[..., Any]:
        """A function (x, ..., c) of x (n,) that returns y (rows,) and dy/dx (rows, n)."""

    @property
    def of_points(self) -> Callable[..., Any]:
        """A function (X, ..., c) of points X (n, points) that returns the values (rows, points)."""


class GivenModel:
    """A model as a page sees it.

    Attributes:
        x, P: the belief.
        X: points (n, points) in its place, of filters that have some.
        u, z: input and measurement.
        Q, R, constants, own: the numbers of the model and of the filter.
        state_angles, measurement_angles: flags of components that are angles.
    """

    def __init__(self, f: Equation, h: Equation, shape: Shape, page: Page):
        """Take the equations, the sizes, and the page."""
        n, m, self.x = shape.n, shape.m, given("x", (shape.n,))
        self.P, self.Q, self.R = self._symmetric("P", n), self._symmetric("Q", n), self._symmetric("R", m)
        self.u, self.z = self._beside("u", shape.inputs), self._beside("z", m)
        self.constants = self._beside("c", shape.constants)
        self.kept: dict[str, Matrix] = {}
        self.own = page.parameters(lambda place, size: self._beside("own", *size))
        points = 0 if page.begin is None else page.begin(self, self.x, self.P).shape[1]
        self.X = self._beside("X", n, points)
        self.state_angles, self.measurement_angles = shape.state_angles, shape.measurement_angles
        self._f, self._h = _Operations(f, n, n), _Operations(h, m, n)

    def _beside(self, name: str, *shape: int) -> Matrix:
        return given(name, shape, beside=self.x)

    def _symmetric(self, name: str, size: int) -> Matrix:
        return given(name, (size, size), symmetric=True, beside=self.x)

    def f(self, x: Matrix, u: Matrix) -> Matrix:
        """The state, a substep after x; of points (n, points) that of each."""
        return self._f.value_at(x, u, self.constants)

    def F(self, x: Matrix, u: Matrix) -> Matrix:  # noqa: N802
        """df/dx."""
        return self._f.matrix(self._f.both(x, u, self.constants))

    def h(self, x: Matrix) -> Matrix:
        """What is measured at x; of points (n, points) at each."""
        return self._h.value_at(x, self.constants)

    def H(self, x: Matrix) -> Matrix:  # noqa: N802
        """dh/dx."""
        return self._h.matrix(self._h.both(x, self.constants))


class _Operations:
    """An equation as operations on Matrices; its value and its Jacobian are worked out together."""

    def __init__(self, equation: Equation, rows: int, n: int):
        self.both = Operation(equation.with_jacobian, lambda *_: (), never)
        self.of_points = Operation(equation.of_points, lambda x, *_: (rows, x[1]), never)
        self.value = Operation(lambda both: both[0], lambda _: (rows,), never)
        self.matrix = Operation(lambda both: both[1], lambda _: (rows, n), never)

    def value_at(self, x: Matrix, *others: Matrix) -> Matrix:
        return self.value(self.both(x, *others)) if len(x.shape) == 1 else self.of_points(x, *others)


class Paged:
    """The functions of a page for a model, as what they return.

    Attributes:
        given: the model, and the matrices that are given.
        state: what `advance` changes: (x, P), or (X,).
        begin: the points of a belief (X,), or nothing.
        advance: the state after one of the model's substeps.
        settle: (x, P) at the end of a step.
        update: (x, P, v, S, log N(v; 0, S)).
    """

    def __init__(self, f: Equation, h: Equation, shape: Shape, page: Page):
        """Call the page."""
        self.given = model = GivenModel(f, h, shape, page)
        self.state: tuple[Matrix, ...]
        self.begin: tuple[Matrix, ...]
        self.advance: tuple[Matrix, ...]
        if page.begin is None:
            self.state, self.begin = (model.x, model.P), ()
            self.advance = tuple(page.advance(model, *self.state, model.u))
        else:
            self.state, self.begin = (model.X,), (page.begin(model, model.x, model.P),)
            self.advance = (page.advance(model, *self.state, model.u),)
        self.settle: tuple[Matrix, ...] = tuple(page.settle(model, *self.state))
        self.update: tuple[Matrix, ...] = tuple(page.update(model, model.x, model.P, model.z))
