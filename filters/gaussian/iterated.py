"""The iterated extended Kalman filter: the measurement is linearised again where the update ends."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from filters.algebra.densities import log_density
from filters.algebra.operations import divide, joseph, only, present, sym, uncorrelated, wrap
from filters.gaussian.extended import advance, settle
from filters.pages.page_filter import Page, PageFilter
from thruster_env.core.checks import at_least

MOST_ITERATIONS = 20


def update(model, x, P, z):
    """The measurement z; channels that are NaN are missing."""
    seen, R, at, told = present(z), uncorrelated(present(z), model.R), x, []
    for i in range(model.own.iterations):
        H, y = only(seen, model.H(at)), model.h(at)
        on_tangent = y + H @ (x - at) if i else y
        v = only(seen, wrap(z - on_tangent, model.measurement_angles))
        S = sym(H @ P @ H.T + R)
        K = divide(P @ H.T, S)
        at = x + K @ v
        told.append((v, S))
    v, S = told[0]
    return wrap(at, model.state_angles), joseph(P, K, H, R), v, S, log_density(v, S, seen)


@dataclass(frozen=True, kw_only=True, eq=False)
class IteratedExtendedKalmanFilter(PageFilter):
    """Iterated extended Kalman filter: its update is Gauss and Newton's method for the most probable state.

        predict: that of the extended filter
        update:  x_0 = x,  then for i = 0, 1, ... with H = dh/dx at x_i and K = P H' (H P H' + R)^-1
                 x_{i+1} = x + K (z - h(x_i) - H (x - x_i)),
                 at last x = x_i,  P = (I - K H) P (I - K H)' + K R K'  (Joseph) with the last H and K

    The first iteration is the extended filter's update. Innovation, its covariance and the likelihood are those of
    the first, so that they assess the prediction. The number of iterations is fixed, without a line search: full
    steps may overshoot where h is strongly nonlinear within the spread of the belief.

    Attributes:
        iterations: how often the measurement is linearised, 1 to 20; 1 is the extended filter.

    Raises:
        ValueError: if iterations is not a whole number from 1 to 20.

    Source: Bell, Cathey (1993), "The iterated Kalman filter update as a Gauss-Newton method", IEEE Trans.
    Automatic Control 38(2).
    """

    name: ClassVar[str] = "iekf"
    page: ClassVar[Page] = Page(advance, settle, update)
    unrolled: ClassVar[tuple[str, ...]] = ("iterations",)
    iterations: int = 5

    def __post_init__(self):
        """Check the number of iterations."""
        iterations = at_least("iterations", self.iterations, 1, MOST_ITERATIONS)
        object.__setattr__(self, "iterations", iterations)
