"""The Schmidt-Kalman filter: states whose uncertainty counts, but which measurements do not correct."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from filters.algebra.densities import log_density
from filters.algebra.operations import divide, joseph, only, present, sym, uncorrelated, wrap
from filters.baselines.baselines import places_of
from filters.gaussian.extended import advance, settle
from filters.pages.page_filter import Page, PageFilter


def update(model, x, P, z):
    """The measurement z; channels that are NaN are missing."""
    seen = present(z)
    H, R = only(seen, model.H(x)), uncorrelated(seen, model.R)
    v = only(seen, wrap(z - model.h(x), model.measurement_angles))
    S = sym(H @ P @ H.T + R)
    K = model.own.corrected @ divide(P @ H.T, S)
    return wrap(x + K @ v, model.state_angles), joseph(P, K, H, R), v, S, log_density(v, S, seen)


@dataclass(frozen=True, kw_only=True, eq=False)
class SchmidtKalmanFilter(PageFilter):
    """Schmidt's extended Kalman filter, with states that are considered, not estimated.

        predict: the extended filter's
        update:  K = J P H' S^-1, where J is the identity without the considered states;
                 x += K v,  P = (I - K H) P (I - K H)' + K R K'

    A bias that the measurements hardly tell, or tell wrongly, keeps its prior, and P says what that costs. Without
    considered states this is the extended filter.

    Attributes:
        considered: indices of these states; -1 is the last one.

    Raises:
        ValueError: if an index is none of a state.

    Source: Schmidt (1966), "Application of state-space methods to navigation problems"; Simon (2006), Optimal
    State Estimation, section 10.1.
    """

    name: ClassVar[str] = "schmidt"
    page: ClassVar[Page] = Page(advance, settle, update)
    considered: Any = ()

    def __post_init__(self):
        """Check the indices; raise ValueError that states the rule and the value."""
        places = places_of("considered", self.considered, self.model.n)
        object.__setattr__(self, "considered", places)

    @cached_property
    def parameters(self) -> dict[str, Any]:
        """J."""
        return {"corrected": np.diag([float(i not in self.considered) for i in range(self.model.n)])}
