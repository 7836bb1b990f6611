"""Sage and Husa's adaptive filter: an extended Kalman filter that learns R, and Q if asked, as it goes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from filters.adaptive.noise import bounded_step, part_that_is_kept
from filters.algebra.densities import log_density
from filters.algebra.operations import divide, joseph, only, present, sym, uncorrelated, wrap
from filters.algebra.points import outer
from filters.algebra.scalars import choose, constant, exceeds, shifted
from filters.engine.belief import Belief
from filters.gaussian.extended import advance
from filters.pages.page_filter import Page, PageFilter


def start(model):
    """The model's R and Q, before any prediction."""
    return {"R": model.R, "Q": model.Q, "predicted": constant(0.0, model.own.forgetting_factor)}


def settle(model, x, P):
    """The end of a step."""
    Q = model.kept["Q"] if model.own.learns_q else model.Q
    return x, sym(P + Q), {"Q": Q, "predicted": constant(1.0, model.own.forgetting_factor)}


def update(model, x, P, z):
    """The measurement z; channels that are NaN are missing."""
    seen, R, Q, old = present(z), model.kept["R"], model.kept["Q"], P
    H, used = only(seen, model.H(x)), uncorrelated(seen, R)
    v = only(seen, wrap(z - model.h(x), model.measurement_angles))
    S = sym(H @ P @ H.T + used)
    K = divide(P @ H.T, S)
    moved, P, of_seen = K @ v, joseph(P, K, H, used), sym(only(seen, only(seen, S).T))
    for_r, for_q = (shifted(factor * -1.0, 1.0) for factor in model.own[:2])
    R = choose(exceeds(for_r, 0.0), bounded_step(R, outer(v, v), of_seen, for_r), R)
    if model.own.learns_q:  # K v v' K' and K S K' by what the update changed
        after = bounded_step(Q, outer(moved, moved), old - P, for_q)
        Q = choose(exceeds(model.kept["predicted"], 0.0), after, Q)
    kept = {"R": R, "Q": Q, "predicted": constant(0.0, for_r)}
    return wrap(x + moved, model.state_angles), P, v, S, log_density(v, S, seen), kept


@dataclass(frozen=True, kw_only=True, eq=False)
class SageHusaFilter(PageFilter):
    """Extended Kalman filter that learns R, and Q if asked, from its innovations, with fading memory.

        predict, update: the extended filter's, with the estimates of Q and R in place of the model's
        after an update: R = a R + (1 - a)(i i' - H P H') = R + (1 - a)(i i' - S),  i the innovation
                         Q = Q + (1 - b) K (i i' - S) K' = b Q + (1 - b)(K i i' K' + P_new - F P_old F')

    with P before the update in the first line, P_new after it and P_old before the prediction in the second. On
    average nothing changes if S is the covariance of the innovation. Since i i' - H P H' may be indefinite, a step
    R + d (i i' - S) is limited to d = 1/(2 trace(R^-1 S)), and that of Q likewise, which leaves at least half of
    R: both stay positive definite by construction. A missing channel changes nothing in its row and column of R.
    One channel can rarely distinguish Q from R: with b = 1 Q stays the model's, and a singular Q always does.

    `Belief.extras` holds R (m m numbers), Q (n n), and 1 between a prediction and its update, else 0.

    Attributes:
        forgetting_factor: a, above 0 and at most 1; R is that of the last 1/(1 - a) measurements or so, and with
            a = 1 the model's.
        process_forgetting_factor: b, above 0 and at most 1.

    Raises:
        ValueError: if a factor is not above 0 and at most 1.

    Source: Sage, Husa (1969), "Adaptive filtering with unknown prior statistics"; Mehra (1972), "Approaches to
    adaptive filtering", IEEE Trans. Automatic Control 17(5), on matching covariances. The bound on d is ours.
    """

    name: ClassVar[str] = "sage-husa"
    page: ClassVar[Page] = Page(advance, settle, update, start=start)
    varying_noise: ClassVar[bool] = False  # R, and Q if it is learnt, are in the belief
    any_step: ClassVar[bool] = False  # it estimates the Q of a step
    forgetting_factor: float = 0.995
    process_forgetting_factor: float = 1.0

    def __post_init__(self):
        """Check the factors; raise ValueError that states the rule and the value."""
        for name in ("forgetting_factor", "process_forgetting_factor"):
            object.__setattr__(self, name, part_that_is_kept(name, getattr(self, name)))

    @property
    def learns_q(self) -> bool:
        """Whether it estimates Q, too."""
        return self.process_forgetting_factor < 1.0

    @property
    def fixed_noise(self) -> tuple[str, ...]:
        """What it estimates."""
        return ("Q", "R") if self.learns_q else ("R",)

    @property
    def written_page(self) -> Page:
        """The page, with or without what learns Q."""
        return super().written_page._replace(fixed=(("learns_q", self.learns_q),))

    def estimated_noise(self, belief: Belief) -> np.ndarray:
        """The estimate of R (m, m) in a belief."""
        m = self.model.m
        return belief.extras[: m * m].reshape(m, m).copy()

    def estimated_process_noise(self, belief: Belief) -> np.ndarray:
        """The estimate of Q (n, n) in a belief."""
        n, first = self.model.n, self.model.m**2
        return belief.extras[first : first + n * n].reshape(n, n).copy()
