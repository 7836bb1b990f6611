"""The cubature Kalman filter: moments by the third-degree rule, whose points have equal weights.

    points:  X = x 1' + g L U,  L L' = P,  U = [I, -I],  g = sqrt(n)
    moments: of values Y, with w = 1/(2n):  mean y = w Y 1,  D = Y - y 1',  cov w D D'
    predict: x, P = mean(f(X, u)), cov(f(X, u)) + Q
    update:  v = z - mean(h(X)),  S = cov(h(X)) + R,  K = w g L U D' S^-1,  x += K v,
             P = w (g L U - K D) (g L U - K D)' + K R K'

The last line equals P - K S K'.

Source: Arasaratnam, Haykin (2009), "Cubature Kalman filters", IEEE Trans. Automatic Control 54(6), section IV.
"""

from __future__ import annotations

from filters.pages.unscented import advance
from numerics.algebra.densities import log_density
from numerics.algebra.operations import divide, of_best_gain, only, present, sym, uncorrelated, wrap
from numerics.algebra.points import on_circle, ones, others, outer, root, square, units

__all__ = ["advance", "begin", "settle", "update"]


def begin(model, x, P):
    """The points of a belief."""
    return points(model, x, root(P))


def points(model, x, L):
    """The points around the mean."""
    g, _, _ = model.own
    return outer(x, ones(others(units(x)))) + (L * g) @ others(units(x))


def moments(model, Y, angles):
    """Mean of values at the points, and their deviations; angles first come to one side of their mean."""
    _, w, _ = model.own
    Y = on_circle(Y, angles)
    y = (Y @ ones(Y)) * w
    return y, Y - outer(y, ones(Y))


def settle(model, X):
    """The end of a step."""
    _, w, _ = model.own
    x, D = moments(model, X, model.state_angles)
    return wrap(x, model.state_angles), square(D) * w + model.Q


def update(model, x, P, z):
    """The measurement z; channels that are NaN are missing."""
    (g, w, _), L, U, seen = model.own, root(P), others(units(x)), present(z)
    y, D = moments(model, model.h(points(model, x, L)), model.measurement_angles)
    D, R = only(seen, D), uncorrelated(seen, model.R)
    v = only(seen, wrap(z - y, model.measurement_angles))
    C = (L @ (U @ D.T)) * (w * g)
    S = square(D) * w + R
    K = divide(C, S)
    rest = square((L * g) @ U - K @ D) * w + sym(K @ R @ K.T)
    return wrap(x + K @ v, model.state_angles), of_best_gain(rest, P, C, S, K), v, S, log_density(v, S, seen)
