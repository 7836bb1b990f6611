"""A page as functions of tensors: of a belief, an input, a measurement, and the numbers of a model."""

from __future__ import annotations

from collections.abc import Mapping

from torch import Tensor

from filters.pages.page import Page
from filters.pages.paged import Equation, Paged
from filters.tensors.algebra import work_out
from numerics.algebra.matrices import Matrix, in_order
from plants.shape import Shape


class Part:
    """A function of a page, which tensors in the places of matrices that are given work out."""

    def __init__(self, *wanted: Matrix):
        """Take what it returns."""
        self._wanted, self._order = wanted, in_order(wanted)

    def __call__(self, known: Mapping[Matrix, Tensor], like: Tensor) -> list[Tensor]:
        """What it returns, given what that is made of."""
        found = work_out(self._order, known, like)
        return [found[one] for one in self._wanted]


class Stages:
    """The functions of a page, for a model's equations."""

    def __init__(self, f: Equation, h: Equation, shape: Shape, page: Page):
        """Make graphs of matrices of the page."""
        paged = Paged(f, h, shape, page)
        self.given, self._state = paged.given, paged.state
        self._begin, self._advance = Part(*paged.begin), Part(*paged.advance)
        self._settle, self._update = Part(*paged.settle), Part(*paged.update)

    def predict(
        self, known: Mapping[Matrix, Tensor], mean: Tensor, cov: Tensor, u: Tensor, substeps: int
    ) -> list[Tensor]:
        """Mean and covariance a step later."""
        known = {**known, self.given.x: mean, self.given.P: cov, self.given.u: u}
        for part in (self._begin, *[self._advance] * substeps):
            known |= dict(zip(self._state, part(known, mean), strict=False))
        return self._settle(known, mean)

    def update(self, known: Mapping[Matrix, Tensor], mean: Tensor, cov: Tensor, z: Tensor) -> list[Tensor]:
        """Mean and covariance after the measurement z, the innovation, its covariance and its log density."""
        return self._update({**known, self.given.x: mean, self.given.P: cov, self.given.z: z}, mean)
