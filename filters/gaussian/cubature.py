"""The cubature Kalman filter: moments by the third-degree spherical-radial rule, with equal weights."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from filters.algebra.densities import log_density
from filters.algebra.operations import divide, of_best_gain, only, present, sym, uncorrelated, wrap
from filters.algebra.points import on_circle, ones, others, outer, root, square, units
from filters.gaussian.unscented_points import advance
from filters.pages.page_filter import Page, PageFilter


def begin(model, x, P):
    """The points of a belief."""
    return points(model, x, root(P))


def points(model, x, L):
    """The points around the mean."""
    return outer(x, ones(others(units(x)))) + (L * model.own.spread) @ others(units(x))


def moments(model, Y, angles):
    """Mean of values at the points, and their deviations; angles first come to one side of their mean."""
    Y = on_circle(Y, angles)
    y = (Y @ ones(Y)) * model.own.weight
    return y, Y - outer(y, ones(Y))


def settle(model, X):
    """The end of a step."""
    x, D = moments(model, X, model.state_angles)
    return wrap(x, model.state_angles), square(D) * model.own.weight + model.Q


def update(model, x, P, z):
    """The measurement z; channels that are NaN are missing."""
    (g, w), L, U, seen = model.own, root(P), others(units(x)), present(z)
    y, D = moments(model, model.h(points(model, x, L)), model.measurement_angles)
    D, R = only(seen, D), uncorrelated(seen, model.R)
    v = only(seen, wrap(z - y, model.measurement_angles))
    C = (L @ (U @ D.T)) * (w * g)
    S = square(D) * w + R
    K = divide(C, S)
    rest = square((L * g) @ U - K @ D) * w + sym(K @ R @ K.T)
    return wrap(x + K @ v, model.state_angles), of_best_gain(rest, P, C, S, K), v, S, log_density(v, S, seen)


@dataclass(frozen=True, kw_only=True, eq=False)
class CubatureKalmanFilter(PageFilter):
    """Cubature Kalman filter with additive noise.

        points:  X = x 1' + g L U,  L L' = P,  U = [I, -I],  g = sqrt(n): x + sqrt(n) L_i and x - sqrt(n) L_i
        moments: of values Y, with w = 1/(2n):  mean y = w Y 1,  D = Y - y 1',  cov w D D'
        predict: x, P = mean(f(X, u)), cov(f(X, u)) + Q
        update:  points again, from the predicted x and P;  v = z - mean(h(X)),  S = cov(h(X)) + R,
                 K = w g L U D' S^-1,  x += K v,  P = w (g L U - K D) (g L U - K D)' + K R K'

    The last line equals P - K S K'; sums of squares, all covariances are symmetric and positive by construction.
    The rule is exact for cubic f and h. It has no parameters: it gives the moments of an unscented filter with
    alpha = 1 and beta = kappa = 0, and does not ask for f and h at the mean itself.

    Source: Arasaratnam, Haykin (2009), "Cubature Kalman filters", IEEE Trans. Automatic Control 54(6), section IV.
    """

    name: ClassVar[str] = "ckf"
    page: ClassVar[Page] = Page(advance, settle, update, begin)

    @property
    def parameters(self) -> dict[str, float]:
        """Where the points lie, and their weight."""
        n = self.model.n
        return {"spread": n**0.5, "weight": 0.5 / n}
