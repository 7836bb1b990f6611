"""The finite-size ensemble Kalman filter: inflation that follows from the innovation and the number of members."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from filters.algebra.densities import dot
from filters.algebra.geometric import geometric_mean
from filters.algebra.members import mean
from filters.algebra.operations import divide, eye, present, sym
from filters.algebra.points import root
from filters.algebra.scalars import at_least, choose, constant, count, exceeds, exponential, trace
from filters.ensembles.deterministic import DeterministicUpdateFilter
from filters.ensembles.steps import advance, compare, settle
from filters.pages.page_filter import Page
from thruster_env.core.checks import positive

ROUNDS = 8  # of Newton's method; innovations of up to two standard deviations need six
FLATTEST = 0.25  # smallest slope that it divides by


def variance_factor(own, A, R, v):
    """The factor t on the covariance A of y for which J(t) is least."""
    L = root(A)
    B = divide(L.T, R)
    G, g = sym(B @ L), B @ v
    unit = eye(G)
    shift = exponential((trace(divide(G, unit + G)) / own.size - 1.0) * own.log_mode)
    low, high = own.low * shift, own.high / shift
    t, least = constant(1.0, own.size), low / high
    for _ in range(ROUNDS):
        of = unit + G * t
        q = divide(g, of)  # t q'q is the square of the members' weights
        rest = t - (low + t * t * dot(q, q) / own.degrees) / high
        slope = 1.0 - t * 2.0 * dot(q, divide(q, of)) / (own.degrees * high)
        t = t - rest / at_least(slope, FLATTEST)
        t = choose(exceeds(t - least, 0.0), t, least)
    return t


def update(model, x, z, e):
    """The measurement z; channels that are NaN are missing."""
    d, C, v, S, R, level = compare(model, x, z)
    t = variance_factor(model.own, S - R, R, v)
    t = choose(exceeds(count(present(z)), 0.0), t, constant(1.0, t))
    spread, C, total = t**0.5, C * t, (S - R) * t + R
    x = x + (x - mean(x)) * (spread - 1.0)
    return x + (divide(C, total) @ v - divide(C, total + geometric_mean(R, total)) @ (d * spread)), v, S, level


@dataclass(frozen=True, kw_only=True, eq=False)
class FiniteSizeEnsembleFilter(DeterministicUpdateFilter):
    """Finite-size ensemble Kalman filter (EnKF-N): the ensemble transform filter with an inflation of its own.

        predict: x_j = f(x_j, u) + w_j,  w_j ~ N(0, Q)
        update:  y_j = h(x_j),  A = cov(y, y),  v = z - mean(y);  t > 0 where
                 J(t) = v' (t A + R)^-1 v/(N - 1) + a/t + b log t  is least;
                 x_j = mean + t^1/2 (x_j - mean);  then the update of the `EnsembleTransformFilter`
        with     a = certainty (1 + 1/N) c,  b = certainty N/((N - 1) c),  c = (1 - 1/N^2)^(-r/2),
                 r = 1 - trace(A (A + R)^-1)/N

    N members know mean and covariance of the forecast but roughly. With Jeffreys' prior for both, the forecast is
    not Gaussian; its mode is that of a Gaussian whose covariance is t times the sample's. So inflation need not be
    tuned for the error of sampling; what the model does not know is still for Q. J is in the dual form; c makes t
    = 1 where measurements say nothing. Eight rounds of Newton's method begin at t = 1: they end in a minimum but
    for innovations beyond some four standard deviations, a few in a hundred of which end on the way.

    The innovation, its covariance and the log-likelihood are those before the inflation, which knows z.

    Attributes:
        certainty: of the ensemble's covariance: 1 for members that are like independent draws, as of a chaotic or
            noisy plant, more for fewer surprises. The others are those of `DeterministicUpdateFilter`.

    Raises:
        ValueError: if a parameter is out of its range.

    Source: Bocquet (2011), "Ensemble Kalman filtering without the intrinsic need for inflation"; the dual form:
    Bocquet, Raanes, Hannart (2015), "Expanding the validity of the ensemble Kalman filter without the intrinsic
    need for inflation"; certainty and c as in Raanes, Bocquet, Carrassi (2019), "Adaptive covariance inflation in
    the ensemble Kalman filter by Gaussian scale mixtures".
    """

    name: ClassVar[str] = "enkf-n"
    page: ClassVar[Page] = Page(advance, settle, update)
    certainty: float = 1.0

    def __post_init__(self):
        """Check the parameters; raise ValueError that states the rule and the value."""
        super().__post_init__()
        object.__setattr__(self, "certainty", positive("certainty", self.certainty))

    @property
    def parameters(self) -> Mapping[str, Any]:
        """Those of all ensembles, and what J is made of."""
        size = self.ensemble_size
        given = super().parameters
        return {
            **{name: value for name, value in given.items() if name != "certainty"},
            "size": size,
            "degrees": size - 1,
            "low": self.certainty * (size + 1) / size,
            "high": self.certainty * size / (size - 1),
            "log_mode": 0.5 * math.log1p(-1.0 / size**2),
        }
