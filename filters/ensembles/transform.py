"""The ensemble transform Kalman filter: members moved by the symmetric square root."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from filters.algebra.geometric import geometric_mean
from filters.algebra.operations import divide
from filters.ensembles.by_parts import LocalisedByParts
from filters.ensembles.deterministic import DeterministicUpdateFilter
from filters.ensembles.steps import advance, compare, settle
from filters.pages.page_filter import Page


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
    a local ensemble transform Kalman filter", section 2.3, here without localisation, which the
    `LocalEnsembleTransformFilter` has.
    """

    name: ClassVar[str] = "etkf"
    page: ClassVar[Page] = Page(advance, settle, update)


@dataclass(frozen=True, kw_only=True, eq=False)
class LocalEnsembleTransformFilter(LocalisedByParts, EnsembleTransformFilter):
    """Local ensemble transform Kalman filter (LETKF): each state has an analysis of its own, with what lies near.

        predict: x_j = f(x_j, u) + w_j,  w_j ~ N(0, Q)
        update:  state i is moved as by the `EnsembleTransformFilter` with R_kk/taper(distance of i and k) in
                 place of each R_kk (R-localisation), by Gaspari and Cohn's taper; tapers below 0.001 are zero

    N members span N - 1 directions, which are enough for a field of any length if what lies far apart is not
    correlated. The model says where its states and measurements lie (`Positions`); without a radius it is the
    `EnsembleTransformFilter`. Innovation, its covariance and log-likelihood are those without tapers.

    Attributes:
        radius: at which a channel counts about 0.6 times, in the unit of the positions; 0 for no localisation. The
            others are those of `DeterministicUpdateFilter`.

    Raises:
        ValueError: if a parameter is out of its range; for a radius also if the model has no positions.

    Source: Hunt, Kostelich, Szunyogh (2007), "Efficient data assimilation for spatiotemporal chaos: a local
    ensemble transform Kalman filter".
    """

    name: ClassVar[str] = "letkf"
