"""The ensemble transform Kalman filter: members moved by the symmetric square root."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from filters.ensembles.deterministic import DeterministicUpdateFilter
from filters.ensembles.ensemble import advance, compare, settle
from filters.pages.page_filter import Page
from thruster_env.numerics.algebra.geometric import geometric_mean
from thruster_env.numerics.algebra.operations import divide


def update(model, x, z, e):
    """The measurement z; channels that are NaN are missing."""
    d, C, v, S, R, level = compare(model, x, z)
    return x + (divide(C, S) @ v - divide(C, S + geometric_mean(R, S)) @ d), v, S, level


@dataclass(frozen=True, kw_only=True, eq=False)
class EnsembleTransformFilter(DeterministicUpdateFilter):
    """Ensemble transform Kalman filter (ETKF) with the symmetric square root, without perturbed measurements.

        predict: x_j = f(x_j, u) + w_j,  w_j ~ N(0, Q)
        update:  y_j = h(x_j),  innovation = z - mean(y),  X (n, N) and Y (m, N) the distances from the means,
                 mean(x) += X T^2 Y' R^-1 innovation/(N - 1),  X = X T,  T = (I + Y' R^-1 Y/(N - 1))^-1/2

    T is symmetric: the mean stays exactly, and the members move as little as they can. It is N x N and never
    formed. With S = Y Y'/(N - 1) + R and the geometric mean R # S = R (R^-1 S)^1/2 of the two, which is the root
    of R S for one channel, T = I - Y' (S + R # S)^-1 Y/(N - 1) and X T = X - cov(x, y) (S + R # S)^-1 Y.

    The covariance after an update is exactly P - K S K', where the stochastic filter's is so on average only; the
    mean moves as the Kalman filter's. The update draws nothing: only the process noise of the members is random,
    and the error of its sample mean and covariance enters the estimate. Attributes are those of
    `DeterministicUpdateFilter`.

    Source: Bishop, Etherton, Majumdar (2001), "Adaptive sampling with the ensemble transform Kalman filter", part
    I; the symmetric root: Hunt, Kostelich, Szunyogh (2007), "Efficient data assimilation for spatiotemporal chaos:
    a local ensemble transform Kalman filter", section 2.3, here without localisation.
    """

    name: ClassVar[str] = "etkf"
    page: ClassVar[Page] = Page(advance, settle, update)
