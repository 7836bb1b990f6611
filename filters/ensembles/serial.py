"""The serial ensemble square root filter: measurements taken in one channel after the other."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

from filters.algebra.blocks import triangle_quotient
from filters.algebra.operations import divide
from filters.algebra.points import root
from filters.ensembles.by_parts import LocalisedByParts
from filters.ensembles.parts import gaussian_moves
from filters.ensembles.steps import advance, compare, settle
from filters.pages.page_filter import Page


def update(model, x, z, e):
    """The measurement z; channels that are NaN are missing."""
    d, C, v, S, R, level = compare(model, x, z)
    K, L, M = divide(C, S), root(S), root(R)
    return x + (K @ v - triangle_quotient(K @ L, L + M) @ d), v, S, level


@dataclass(frozen=True, kw_only=True, eq=False)
class SerialSquareRootFilter(LocalisedByParts):
    """Serial ensemble square root filter (EnSRF), without perturbed measurements.

        predict: x_j = f(x_j, u) + w_j,  w_j ~ N(0, Q)
        update:  y_j = M^-1 h(x_j) and z = M^-1 z, M the lower triangular root of R: channels with independent
                 noise of variance 1; then for one channel i after the other, in x and in the channels to come,
                 s = var(y_i) + 1,  k = cov(x, y_i)/s,  mean += k (z_i - mean(y_i)),
                 x_j - mean(x) -= k (y_ij - mean(y_i))/(1 + s^-1/2);  sample covariances with divisor N - 1

    For all channels together that is x_j += K innovation - K L (L + M)^-1 (h(x_j) - mean(h)), with L the lower
    triangular root of S = cov(h, h) + R: Andrews' square root, for taking the channels in turn is the elimination
    that makes L. So it is computed. The covariance after an update is exactly P - K S K', where the stochastic
    filter's is so on average only; the mean moves as the Kalman filter's. The update draws nothing: only the
    process noise of the members is random, and the error of its sample mean and covariance enters the estimate.

    With one channel it is the `EnsembleTransformFilter`. Close relatives go by the name of EnKF-SR in the
    literature on ships.

    With a radius the gain k of a state is tapered by its distance from the channel (P-localisation), and each
    channel is predicted anew from the members that those before have moved.

    Attributes:
        radius: of Gaspari and Cohn's taper, in the unit of the model's `Positions`; 0 for no localisation. The
            others are those of `DeterministicUpdateFilter`.

    Raises:
        ValueError: if a parameter is out of its range; for a radius also if the model has no positions.

    Source: Whitaker, Hamill (2002), "Ensemble data assimilation without perturbed observations", equations (10) to
    (13); Andrews (1968), "A square root formulation of the Kalman covariance equations"; with tapers: Karspeck,
    Anderson (2007), "Experimental implementation of an ensemble adjustment filter for an intermediate ENSO model".
    """

    name: ClassVar[str] = "ensrf"
    page: ClassVar[Page] = Page(advance, settle, update)
    moves_of: ClassVar[Callable | None] = staticmethod(gaussian_moves)
