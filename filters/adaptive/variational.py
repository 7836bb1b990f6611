"""The variational Bayesian filter: an extended Kalman filter with an inverse Wishart belief of R."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from filters.adaptive.noise import noise_moment, part_that_is_kept
from filters.algebra.densities import log_density
from filters.algebra.operations import divide, joseph, only, present, sym, uncorrelated, wrap
from filters.algebra.scalars import choose, count, exceeds
from filters.engine.belief import Belief
from filters.gaussian.extended import advance, settle
from filters.pages.page_filter import Page, PageFilter
from thruster_env.core.checks import at_least, positive

MOST_ITERATIONS = 50  # that are written out


def start(model):
    """The prior's distribution of R."""
    return {"V": model.R * model.own.prior_weight, "nu": model.own.prior_weight}


def update(model, x, P, z):
    """The measurement z; channels that are NaN are missing."""
    rho, V, nu, seen = model.own.forgetting_factor, model.kept["V"], model.kept["nu"], present(z)
    H = only(seen, model.H(x))
    v, HPH = only(seen, wrap(z - model.h(x), model.measurement_angles)), sym(H @ P @ H.T)
    R, later = V / nu, rho * nu + 1.0
    S = HPH + uncorrelated(seen, R)
    for _ in range(model.own.iterations):
        R = (V * rho + noise_moment(seen, HPH, R, v)) / later
    used = uncorrelated(seen, R)
    K, some = divide(P @ H.T, HPH + used), exceeds(count(seen), 0.0)
    kept = {"V": choose(some, R * later, V), "nu": choose(some, later, nu)}
    x = wrap(x + K @ v, model.state_angles)
    return x, joseph(P, K, H, used), v, S, log_density(v, S, seen), kept


@dataclass(frozen=True, kw_only=True, eq=False)
class VariationalBayesFilter(PageFilter):
    """Extended Kalman filter with an inverse Wishart distribution of R beside mean and P.

        predict: the extended filter's
        update:  repeat R = (rho V + E[v v' | z])/(rho nu + 1), each moment under the R before, then
                 V = rho V + E[v v' | z],  nu = rho nu + 1, and mean and P as in the extended filter with this R

    V (m, m) and nu make the distribution of R; the estimate of R is 1/E[1/R] = V/nu. For one channel this is the
    inverse gamma distribution with alpha = nu/2, beta = V/2. The repetition is the fixed-point iteration of the
    variational approximation in which state and R are independent. Innovation, S and log-likelihood are those
    under the R that was estimated before the measurement. In a missing channel E[v v' | z] follows from the others
    by their correlation in R.

    `Belief.extras` holds V (m m numbers), then nu.

    Attributes:
        forgetting_factor: rho, above 0 and at most 1; R is that of the last 1/(1 - rho) measurements or so.
        prior_weight: initial nu: the model's R counts as much as this many measurements; with rho = 1,
            as it grows, the filter becomes the extended one.
        iterations: of the fixed point, 1 to 50.

    Raises:
        ValueError: if a parameter is out of its range.

    Source: Sarkka, Nummenmaa (2009), "Recursive noise adaptive Kalman filtering by variational Bayesian
    approximations", IEEE Trans. Automatic Control 54(3); with inverse Wishart Sarkka, Hartikainen (2013),
    "Non-linear noise adaptive Kalman filtering via variational Bayes".
    """

    name: ClassVar[str] = "vb"
    page: ClassVar[Page] = Page(advance, settle, update, start=start)
    unrolled: ClassVar[tuple[str, ...]] = ("iterations",)
    varying_noise: ClassVar[bool] = False  # R is in the belief, whose start is the model's
    forgetting_factor: float = 0.99
    prior_weight: float = 10.0
    iterations: int = 3

    def __post_init__(self):
        """Check the parameters; raise ValueError that states the rule and the value."""
        factor = part_that_is_kept("forgetting_factor", self.forgetting_factor)
        object.__setattr__(self, "forgetting_factor", factor)
        object.__setattr__(self, "prior_weight", positive("prior_weight", self.prior_weight))
        object.__setattr__(self, "iterations", at_least("iterations", self.iterations, 1, MOST_ITERATIONS))

    @property
    def fixed_noise(self) -> tuple[str, ...]:
        """R, which it estimates."""
        return ("R",)

    def estimated_noise(self, belief: Belief) -> np.ndarray:
        """The estimate V/nu of R (m, m) in a belief."""
        m = self.model.m
        return belief.extras[: m * m].reshape(m, m) / belief.extras[m * m]
