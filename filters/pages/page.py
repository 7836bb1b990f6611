"""What a filter is that is written as in a textbook: pure functions of small matrices.

The functions take a model, whose f(x, u), F(x, u), h(x), H(x), Q and R are those of the equations, and matrices.
Without points or other forms of the belief a step is

    x, P = add_process_noise(model, *propagate(model, x, P, u)),  propagate once for each of the model's substeps
    x, P, v, S, log N(v; 0, S) = update(model, x, P, z)

Filters that predict another form of the belief, such as sigma points X, have a `represent` that makes it:

    x, P = add_process_noise(model, propagate(model, represent(model, x, P), u))

What else a filter carries, such as an estimate of R, `initial(model)` returns as a dictionary. The functions
read it from `model.extras`, and return what changes in a dictionary behind their other results.
"""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Callable, Mapping
from functools import cache
from math import prod
from typing import Any, NamedTuple

from filters.algebra.matrices import Matrix, given
from filters.engine.belief import memory_places, own_place
from thruster_env.graphs.programs import Place
from thruster_env.model.shape import Shape, number_places


class Page(NamedTuple):
    """The functions of a filter, and what stands in `model.own`."""

    propagate: Callable  # in each of the model's substeps
    add_process_noise: Callable  # at the end of a step
    update: Callable
    represent: Callable | None = None
    initial: Callable | None = None
    own: tuple[tuple[str, tuple[int, ...]], ...] = ()  # parameters and their shapes
    fixed: tuple[tuple[str, Any], ...] = ()  # values that stand in programs, such as how often a loop runs
    rejuvenate: Callable | None = None  # of particles that were resampled
    lookahead: Callable | None = None  # of particles that are resampled in the update, before that
    per_particle: tuple[str, ...] = ()  # what is kept of each particle

    def started(self, model: Any) -> dict[str, Any]:
        """What a filter keeps, at the prior."""
        return {} if self.initial is None else self.initial(model)

    def parameters(self, read: Callable[[int, tuple[int, ...]], Any]) -> Any:
        """What pages find in `model.own`: `read(place, shape)` of each parameter, and fixed values."""
        values, place = [], 0
        for _, shape in self.own:
            values.append(read(place, shape))
            place += prod(shape)
        names = tuple(name for name, _ in (*self.own, *self.fixed))
        return _own_class(names)(*values, *(value for _, value in self.fixed))

    def places(self, first: int) -> dict[str, int]:
        """Where each parameter begins, if they lie one behind the other from `first` on."""
        found = {}
        for name, shape in self.own:
            found[name], first = first, first + prod(shape)
        return found

    @property
    def own_size(self) -> int:
        """How many numbers the parameters are."""
        return sum(prod(shape) for _, shape in self.own)


@cache
def _own_class(names: tuple[str, ...]) -> type:
    return namedtuple("Own", names)


# The matrices that stand for numbers in memory: a model's and a filter's, and those of a belief's row.


class NumbersMemory:
    """What `numbers` holds: Q, R, scales, constants, and the filter's parameters.

    Attributes:
        own: parameters, as pages find them.
        kept: what the filter keeps besides mean and covariance, by name.
        end: the next place in a filter's row, behind what is kept.
        constants_slope, size: along a parameter that moves constants, if there are such.
        ratio: the last input as a number, if it is the step ratio.
        belief: where mean and covariance lie.
        told: where the innovation, its covariance and its log density lie.
    """

    def __init__(self, shape: Shape, page: Page, x: Matrix, p: Matrix, own: int):
        """Take the sizes, matrices that stand for a belief, and where the filter's parameters begin."""
        n, m = shape.n, shape.m
        places, row = number_places(n, m), memory_places(n, m)
        self.belief = Place("rows", row.mean), Place("rows", row.cov)
        self.told = tuple(Place("rows", at) for at in (row.innovation, row.innovation_cov, row.log_likelihood))
        self.shape, self.x, self.P = shape, x, p
        self.Q = self.read("numbers", places.q, n, n, symmetric=True)
        self.R = self.read("numbers", places.r, m, m, symmetric=True)
        self.Q_root = self.read("numbers", places.q_root, n, n)
        self.R_root = self.read("numbers", places.r_root, m, m)
        self.prior_mean = self.read("numbers", places.prior_mean, n)
        self.prior_root = self.read("numbers", places.prior_root, n, n)
        self.scales = self.read("numbers", places.scales, n)
        # Where there are none, they must not lie where the filter's parameters begin: tensors are known by place.
        at = places.constants if shape.constants else places.substeps
        self.constants = self.read("numbers", at, shape.constants)
        self.own = page.parameters(lambda place, size: self.read("numbers", own + place, *size))
        self.kept: Mapping[str, Matrix] = {}
        self.end = row.extras
        self.constants_slope: Matrix | None = None
        self.ratio: Matrix | None = None
        self.size: Matrix | None = None

    def ratio_in(self, array: str, inputs: int) -> Matrix | None:
        """The last of the inputs, which lie in an array from a place on, of a model with a step ratio."""
        return self.read(array, inputs + self.shape.inputs - 1) if self.shape.step_ratio else None

    def read(self, array: str, first: int, *shape: int, symmetric: bool = False) -> Matrix:
        """A matrix that lies in an array from a place on."""
        return given(Place(array, first), shape, symmetric=symmetric, like=self.x)

    def keep(self, started: Mapping[str, Any]) -> Mapping[str, Matrix]:
        """Give what a filter keeps its place, one behind the other."""
        self.kept = {name: self.another(one, symmetric=one.symmetric) for name, one in started.items()}
        return self.kept

    def another(self, like: Matrix, *, symmetric: bool = False) -> Matrix:
        """A matrix of the same shape in the next places of the row."""
        made = self.read("rows", self.end, *like.shape, symmetric=symmetric)
        self.end += prod(like.shape)
        return made


class RowMemory(NumbersMemory):
    """The memory of a filter that runs.

    rows     the row of `filters.engine.belief`: its extras are what the filter keeps, then scratch
    given    u or z
    numbers  the model's, then the filter's own
    """

    def __init__(self, shape: Shape, page: Page):
        """Take the sizes; what is kept or in flight finds its place when it is known."""
        row = memory_places(shape.n, shape.m)
        x = given(Place("rows", row.mean), (shape.n,))
        p = given(Place("rows", row.cov), (shape.n, shape.n), symmetric=True, like=x)
        super().__init__(shape, page, x, p, own_place(shape))
        self.u, self.z = self.read("given", 0, shape.inputs), self.read("given", 0, shape.m)
        self.ratio = self.ratio_in("given", 0)
