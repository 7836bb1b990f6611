"""The H-infinity filter: the least of the largest errors that any noise of some size can cause."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from filters.algebra.operations import divide, eye, sym
from filters.gaussian.extended import advance, update
from filters.pages.page_filter import Page, PageFilter
from thruster_env.core.checks import positive, vector


def settle(model, x, P):
    """The end of a step."""
    W, P = model.own.weights, sym(P + model.Q)
    D = eye(x) - sym(W @ P @ W.T) * model.own.theta
    return x, sym(P + sym(divide(P @ W.T, D) @ (W @ P)) * model.own.theta)


@dataclass(frozen=True, kw_only=True, eq=False)
class HInfinityFilter(PageFilter):
    """Extended H-infinity filter: it guards against the worst noise, not the mean one.

        predict: x = f(x, u),  P = F P F' + Q,  then P = (P^-1 - theta W'W)^-1
        update:  the extended filter's: P = (P^-1 + H' R^-1 H)^-1,  x += P H' R^-1 (z - h(x))

    W = diag(1/scale). Of noise w and v and of first errors e_0 of any kind the sum of |W e|^2 is less than 1/theta
    times the sum of e_0' P_0^-1 e_0, w' Q^-1 w and v' R^-1 v. With theta = 0 it is the extended filter; as theta
    grows, P and the gain do. P is no covariance of random errors but larger, and its NEES below n. Where theta is
    too large for P, as after many steps without a measurement, what is to be inverted is not positive: the filter
    restarts, and that is counted. The prior is taken as it is.

    Attributes:
        theta: the bound, above 0.
        scale: of the errors that matter, (n,), in units of the states; the prior's deviations if None.

    Raises:
        ValueError: if a number is not positive.

    Source: Simon (2006), Optimal State Estimation, eq. (11.89), in two steps; Banavar (1992), "A game theoretic
    approach to linear dynamic estimation".
    """

    name: ClassVar[str] = "h-infinity"
    page: ClassVar[Page] = Page(advance, settle, update)
    theta: float = 0.01
    scale: Any = None

    def __post_init__(self):
        """Check the numbers; raise ValueError that states the rule and the value."""
        object.__setattr__(self, "theta", positive("theta", self.theta))
        if self.scale is not None:
            scale = vector("scale", self.scale, self.model.n)
            object.__setattr__(self, "scale", np.array([positive("scale", one) for one in scale]))

    @cached_property
    def parameters(self) -> dict[str, Any]:
        """Theta and W; a state whose scale is zero has no weight."""
        scale = np.sqrt(np.diag(self.model.prior_cov)) if self.scale is None else self.scale
        weights = np.divide(1.0, scale, out=np.zeros(self.model.n), where=scale > 0.0)
        return {"theta": self.theta, "weights": np.diag(weights)}

    @property
    def follows_from(self) -> Mapping[str, tuple[str, ...]]:
        """W, from the prior's deviations unless there is a scale."""
        return {"weights": ("prior_cov",)} if self.scale is None else {}
