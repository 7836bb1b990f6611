"""The iterated ensemble Kalman filter: the measurement function linearised where the members come to lie."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from filters.ensembles.ensemble import EnsembleFilter, advance, compare, expect, settle
from filters.pages.page_filter import Page
from thruster_env.numerics.algebra.geometric import geometric_mean
from thruster_env.numerics.algebra.members import covariance, mean
from thruster_env.numerics.algebra.operations import divide, only, present, wrap
from thruster_env.numerics.checks import at_least

MOST_ITERATIONS = 20  # that are written out


def update(model, x, z, e):
    """The measurement z; channels that are NaN are missing. Y are the slopes of h along the members' distances."""
    Y, C, v, S, R, level = compare(model, x, z)
    told = v, S, level
    for _ in range(1, model.own.iterations):
        middle = geometric_mean(R, S)
        y = expect(model, x + (divide(C, S) @ v - divide(C, S + middle) @ Y), z)
        E = covariance(y, Y)
        D = divide(E, R + middle)
        moved = divide(E + D @ (S - R), S) @ v
        v = only(present(z), wrap(z - mean(y), model.measurement_angles)) + moved
        Y = y - mean(y) + D @ Y
        C, S = covariance(x, Y), covariance(Y, Y) + R
    return x + (divide(C, S) @ v - divide(C, S + geometric_mean(R, S)) @ Y), *told


@dataclass(frozen=True, kw_only=True, eq=False)
class IteratedEnsembleKalmanFilter(EnsembleFilter):
    """Iterated ensemble Kalman filter (IEnKF) over one update, for nonlinear measurements.

        predict: x_j = f(x_j, u) + w_j,  w_j ~ N(0, Q);  X (n, N) the members' distances from their mean
        update:  least over w (N,) of (N - 1) w'w + (z - h(mean + X w))' R^-1 (z - h(mean + X w)), by Gauss-Newton:
                 from w = 0 and T = I on, `iterations` times,
                 y_j = h(mean + X w + X T e_j),  Y = (y - mean(y)) T^-1,  S = Y Y'/(N - 1) + R,
                 w = Y' S^-1 (z - mean(y) + Y w)/(N - 1),  T = (I + Y' R^-1 Y/(N - 1))^-1/2;
                 then x_j = mean + X w + X T e_j,  e_j the j-th unit vector

    The slopes of h are thus those at the estimate, averaged over its uncertainty. One
    iteration is the `EnsembleTransformFilter`; where h is linear, further ones change nothing. T and its inverse
    are symmetric and N x N, and never formed. The innovation and its covariance are those of the first iteration.

    The motion f is not run again, unlike in methods that re-estimate the last state together with this one (Sakov,
    Oliver and Bertino do so, without process noise). Steps are not damped: where the measurement fits several
    states, iterations may jump between them. Where a measurement is far more accurate than the forecast, T^-1
    magnifies any nonlinearity of h along unobserved directions, and iterations gain little.

    Attributes:
        iterations: evaluations of h by all members in an update, 1 to 20. The others are those of
            `EnsembleFilter`.

    Raises:
        ValueError: if a parameter is out of its range.

    Source: Sakov, Oliver, Bertino (2012), "An iterative EnKF for strongly nonlinear systems"; over the update
    alone it is the filter of Zupanski (2005), "Maximum likelihood ensemble filter: theoretical aspects", solved as
    in Bocquet, Sakov (2012), "Combining inflation-free and iterative ensemble Kalman filters for strongly
    nonlinear systems".
    """

    name: ClassVar[str] = "ienkf"
    page: ClassVar[Page] = Page(advance, settle, update)
    unrolled: ClassVar[tuple[str, ...]] = ("iterations",)
    iterations: int = 3

    def __post_init__(self):
        """Check the parameters; raise ValueError that states the rule and the value."""
        super().__post_init__()
        object.__setattr__(self, "iterations", at_least("iterations", self.iterations, 1, MOST_ITERATIONS))
