"""A page: a filter as a textbook writes it, pure functions of a model and small matrices.

The model has f(x, u), F(x, u), h(x), H(x), Q and R of the equations. If the belief is a mean and a covariance, a
step is

    x, P = add_process_noise(model, *propagate(model, x, P, u)),  propagate once for each of the model's substeps
    x, P, v, S, log N(v; 0, S) = update(model, x, P, z)

Filters that propagate another representation of the belief, such as sigma points X, compute it in `represent`:

    x, P = add_process_noise(model, propagate(model, represent(model, x, P), u))

A filter may keep extras, such as an estimate of R: `initial(model)` returns them as a dictionary at the prior. The
functions read them from `model.extras`; as their last result they may return a dictionary of those that change.
"""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Callable, Mapping
from functools import cache
from math import prod
from typing import Any, NamedTuple

from filters.algebra.matrices import Matrix, input_matrix
from filters.engine.belief import memory_places, own_place
from thruster_env.graphs.programs import Place
from thruster_env.model.shape import Shape, number_places


class Page(NamedTuple):
    """The functions of a filter, and the parameters that they read from `model.own`."""

    propagate: Callable  # in each of the model's substeps
    add_process_noise: Callable  # at the end of a step
    update: Callable
    represent: Callable | None = None
    initial: Callable | None = None
    own: tuple[tuple[str, tuple[int, ...]], ...] = ()  # parameters and their shapes
    fixed: tuple[tuple[str, Any], ...] = ()  # constants of the program, such as the number of iterations
    rejuvenate: Callable | None = None  # particle filters: after resampling
    lookahead: Callable | None = None  # particle filters that resample in the update: before resampling
    per_particle: tuple[str, ...] = ()  # names of extras that each particle has

    def started(self, model: Any) -> dict[str, Any]:
        """The filter's extras at the prior."""
        return {} if self.initial is None else self.initial(model)

    def parameters(self, read: Callable[[int, tuple[int, ...]], Any]) -> Any:
        """`model.own` of pages: `read(offset, shape)` of each parameter, and the fixed values."""
        values = [
            read(at, shape) for at, (_, shape) in zip(self.parameter_offsets(0).values(), self.own, strict=True)
        ]
        names = tuple(name for name, _ in (*self.own, *self.fixed))
        return _own_class(names)(*values, *(value for _, value in self.fixed))

    def parameter_offsets(self, first: int) -> dict[str, int]:
        """The offset of each parameter, if the first has the offset `first`."""
        offsets = {}
        for name, shape in self.own:
            offsets[name], first = first, first + prod(shape)
        return offsets

    @property
    def own_size(self) -> int:
        """Number of floats that the parameters take."""
        return sum(prod(shape) for _, shape in self.own)


@cache
def _own_class(names: tuple[str, ...]) -> type:
    return namedtuple("Own", names)


class NumbersMemory:
    """Matrices read from `numbers`: Q, R, scales, constants, and the filter's parameters.

    Attributes:
        own: parameters, as pages read them.
        kept: the filter's extras, by name.
        end: the first free offset in a filter's row, after the extras.
        constants_slope, size: along a parameter that moves constants, if there are any.
        ratio: the last input as a number, if it is the step ratio.
        belief: places of mean and covariance.
        told: places of the innovation, its covariance and its log density.
    """

    def __init__(self, shape: Shape, page: Page, x: Matrix, p: Matrix, first_parameter: int):
        n, m = shape.n, shape.m
        layout, row = number_places(n, m), memory_places(n, m)
        self.belief = Place("rows", row.mean), Place("rows", row.cov)
        self.told = tuple(Place("rows", at) for at in (row.innovation, row.innovation_cov, row.log_likelihood))
        self.shape, self.x, self.P = shape, x, p
        self.Q = self.read("numbers", layout.q, n, n, symmetric=True)
        self.R = self.read("numbers", layout.r, m, m, symmetric=True)
        self.Q_root = self.read("numbers", layout.q_root, n, n)
        self.R_root = self.read("numbers", layout.r_root, m, m)
        self.prior_mean = self.read("numbers", layout.prior_mean, n)
        self.prior_root = self.read("numbers", layout.prior_root, n, n)
        self.scales = self.read("numbers", layout.scales, n)
        # Tensors are found by place: without constants this must not be the place of the filter's first parameter.
        at = layout.constants if shape.constants else layout.substeps
        self.constants = self.read("numbers", at, shape.constants)
        self.own = page.parameters(lambda offset, size: self.read("numbers", first_parameter + offset, *size))
        self.kept: Mapping[str, Matrix] = {}
        self.end = row.extras
        self.constants_slope: Matrix | None = None
        self.ratio: Matrix | None = None
        self.size: Matrix | None = None

    def ratio_in(self, array: str, inputs: int) -> Matrix | None:
        """The last of the inputs, which begin at offset `inputs` of an array, if it is the step ratio."""
        return self.read(array, inputs + self.shape.inputs - 1) if self.shape.step_ratio else None

    def read(self, array: str, first: int, *shape: int, symmetric: bool = False) -> Matrix:
        """A matrix stored in an array from the offset `first` on."""
        return input_matrix(Place(array, first), shape, symmetric=symmetric, like=self.x)

    def keep(self, started: Mapping[str, Any]) -> Mapping[str, Matrix]:
        """Lay out the extras of a filter in its row, and return them as matrices read from there."""
        self.kept = {name: self.another(value, symmetric=value.symmetric) for name, value in started.items()}
        return self.kept

    def another(self, like: Matrix, *, symmetric: bool = False) -> Matrix:
        """A matrix of the same shape at the first free offset of the row."""
        matrix = self.read("rows", self.end, *like.shape, symmetric=symmetric)
        self.end += prod(like.shape)
        return matrix


class RowMemory(NumbersMemory):
    """The memory of a filter that runs.

    rows     the row of `filters.engine.belief`, with the filter's extras, then scratch
    given    u or z
    numbers  the model's, then the filter's own
    """

    def __init__(self, shape: Shape, page: Page):
        """Take the sizes. Extras and other representations of the belief are laid out once they are known."""
        row = memory_places(shape.n, shape.m)
        x = input_matrix(Place("rows", row.mean), (shape.n,))
        p = input_matrix(Place("rows", row.cov), (shape.n, shape.n), symmetric=True, like=x)
        super().__init__(shape, page, x, p, own_place(shape))
        self.u, self.z = self.read("given", 0, shape.inputs), self.read("given", 0, shape.m)
        self.ratio = self.ratio_in("given", 0)
