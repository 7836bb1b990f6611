"""The class of all ensemble filters: their page, and what controls the spread of the members."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from filters.engine.belief import Belief, Kernels
from filters.ensembles.adaptive import adapted
from filters.ensembles.inflation import inflated, relaxed
from filters.ensembles.spread import checked, limits
from filters.pages.members import members_kernels
from filters.pages.page_filter import FilterWithPage, Page
from thruster_env.core.checks import at_least

LARGEST_ENSEMBLE = 1_000_000
OF_THE_ENGINE = frozenset(  # parameters that no page reads
    "ensemble_size rotations radius adaptive_inflation inflation_by_state least_deviation window".split()
)


@dataclass(frozen=True, kw_only=True, eq=False)
class EnsembleFilter(FilterWithPage):
    """Base of the ensemble filters: subclasses name their page, whose functions say what is done with each member.

        x = settle(model, advance(model, x, u), w),  w ~ N(0, I), advance once for each of the model's substeps
        x, v, S, log N(v; 0, S) = update(model, x, z, e),  e ~ N(0, I)

    What is said of all members together (`filters.algebra.members`) is the same for each: `mean(x)`,
    `covariance(x, y)`. Normals that a page does not use are not drawn. The belief's mean and covariance are those
    of the members.

    Attributes:
        ensemble_size: number N of members, at least 2.
        inflation: factor on the spread of the members about their mean in every step of the model's dt, after the
            process noise; 1 is none. For steps of another length dt' it is inflation^(dt'/dt).
        relaxation: fraction, 0 to 1, of each state's loss of spread in an update that is given back.
        adaptive_inflation: standard deviation, in each update, of a factor on the covariance of each forecast that
            is learnt from the innovations and never below 1, in steps of any length; 0 for none. See
            `filters.ensembles.adaptive`.
        inflation_by_state: 1 if adaptive_inflation learns a factor for each state, 0 if it is one for all.
        least_deviation: if positive, the factor's prior is an inverse gamma density, and adaptive_inflation is its
            first standard deviation, which measurements change and never take below this; both over the factor.

    Sources: Anderson, Anderson (1999), "A Monte Carlo implementation of the nonlinear filtering problem to produce
    ensemble assimilations and forecasts", for inflation; Whitaker, Hamill (2012), "Evaluating methods to account
    for system errors in ensemble data assimilation", for relaxation to the prior spread.
    """

    ensemble_size: int = 100
    inflation: float = 1.0
    relaxation: float = 0.0
    adaptive_inflation: float = 0.0
    inflation_by_state: int = 0
    least_deviation: float = 0.0

    def __post_init__(self):
        """Check the parameters; raise ValueError that states the rule and the value."""
        size = at_least("ensemble_size", self.ensemble_size, 2, LARGEST_ENSEMBLE)
        for name, number in {"ensemble_size": size, **checked(self)}.items():
            object.__setattr__(self, name, number)

    @property
    def by_parts(self) -> bool:
        """Whether an update goes through states or channels, or runs the motion, and is more than the page."""
        return False

    @property
    def size(self) -> int:
        """Number of ensemble members."""
        return self.ensemble_size

    @property
    def parameters(self) -> Mapping[str, Any]:
        """Fields that the page reads, and limits of each factor of an adaptive inflation, if it is chosen."""
        count = np.ones(self.model.n) if self.inflation_by_state else 1.0
        limits_of_factors = limits(self.adaptive_inflation, self.least_deviation).items()
        return {**super().parameters, **{name: count * limit for name, limit in limits_of_factors}}

    def _fields(self) -> Iterator[str]:
        return (name for name in super()._fields() if name not in OF_THE_ENGINE)

    @property
    def written_page(self) -> Page:
        """The page, with what controls the spread where that does something."""
        return self.page_with(self.inflation != 1.0, self.relaxation != 0.0)

    def page_with(self, inflation: bool = True, relaxation: bool = True) -> Page:
        """The page, with inflation, relaxation, or both, and adaptive inflation if it is chosen."""
        page = self.plain_page
        if inflation:
            page = page._replace(settle=inflated(page.settle))
        if relaxation:
            page = page._replace(update=relaxed(page.update))
        return adapted(page) if self.adaptive_inflation else page

    def sample(self, belief: Belief) -> np.ndarray:
        """The members of a belief, (n, N), without what a filter keeps beside them."""
        return belief.members[: self.kernel_model.n]

    def kernels(self) -> Kernels:
        """Kernels of the page for the model's functions; see `Filter.kernels`."""
        return members_kernels(self.written_page, self.kernel_model.functions, self.kernel_model.shape)
