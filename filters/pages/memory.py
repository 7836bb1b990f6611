"""The matrices that stand for numbers in memory: a model's and a filter's, and those of a belief's row."""

from __future__ import annotations

from collections.abc import Mapping
from math import prod
from typing import Any

from filters.algebra.matrices import Matrix, given
from filters.engine.layout import memory_places, own_place
from filters.pages.page import Page
from thruster_env.graphs.programs import Place
from thruster_env.model.layout import number_places
from thruster_env.model.shape import Shape


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

    rows     the row of `filters.engine.layout`: its extras are what the filter keeps, then scratch
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
