"""A robust extended Kalman filter: Student-t measurement noise, so that outliers have little weight."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from filters.adaptive.noise import noise_moment
from filters.algebra.densities import log_density
from filters.algebra.operations import divide, joseph, only, present, sym, uncorrelated, wrap
from filters.algebra.scalars import constant, count, trace
from filters.gaussian.extended import advance, settle
from filters.pages.page_filter import Page, PageFilter
from thruster_env.core.checks import at_least, positive

MOST_ITERATIONS = 50  # that are written out


def start(model):
    """The weight of nothing."""
    return {"weight": constant(1.0, model.own.degrees_of_freedom)}


def update(model, x, P, z):
    """The measurement z; channels that are NaN are missing."""
    d, seen, weight = model.own.degrees_of_freedom, present(z), 1.0
    H, R = only(seen, model.H(x)), uncorrelated(seen, model.R)
    v, HPH = only(seen, wrap(z - model.h(x), model.measurement_angles)), sym(H @ P @ H.T)
    S = HPH + R
    for _ in range(model.own.iterations):
        E = only(seen, noise_moment(seen, HPH, R / weight, v))
        weight = (d + count(seen)) / (d + trace(divide(E, R)))
    R = R / weight
    K = divide(P @ H.T, HPH + R)
    x = wrap(x + K @ v, model.state_angles)
    return x, joseph(P, K, H, R), v, S, log_density(v, S, seen), {"weight": weight}


@dataclass(frozen=True, kw_only=True, eq=False)
class RobustExtendedKalmanFilter(PageFilter):
    """Extended Kalman filter for Student-t measurement noise: outliers have little weight.

        predict: the extended filter's
        update:  from weight = 1 repeat  weight = (d + m)/(d + trace(R^-1 E[v v' | z])), each moment with R/weight
                 in place of R; then the extended filter's update, too, with R/weight in place of R

    The noise v has d degrees of freedom and scale matrix R: it is N(0, R/weight) for a weight that is gamma
    distributed about 1. The repetition is the fixed-point iteration of the variational approximation in which
    state and weight are independent; m counts the measured channels, which share one weight. Innovation, S and
    log-likelihood are those under R itself, so that outliers show in the NIS (normalised innovation squared).

    `Belief.extras` holds the last weight, near 0 for an outlier; 1 where nothing was measured.

    Attributes:
        degrees_of_freedom: d, positive; as it grows the filter becomes the extended one.
        iterations: of the fixed point, 1 to 50.

    Raises:
        ValueError: if a parameter is out of its range.

    Source: Agamennoni, Nieto, Nebot (2012), "Approximate inference in state-space models with heavy-tailed noise",
    IEEE Trans. Signal Processing 60(10), section III; Piche, Sarkka, Hartikainen (2012), "Recursive outlier-robust
    filtering and smoothing for nonlinear systems using the multivariate Student-t distribution".
    """

    name: ClassVar[str] = "ekf-robust"
    page: ClassVar[Page] = Page(advance, settle, update, start=start)
    unrolled: ClassVar[tuple[str, ...]] = ("iterations",)
    degrees_of_freedom: float = 4.0
    iterations: int = 5

    def __post_init__(self):
        """Check the parameters; raise ValueError that states the rule and the value."""
        object.__setattr__(self, "degrees_of_freedom", positive("degrees_of_freedom", self.degrees_of_freedom))
        object.__setattr__(self, "iterations", at_least("iterations", self.iterations, 1, MOST_ITERATIONS))
