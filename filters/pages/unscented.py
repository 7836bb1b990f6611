"""The unscented Kalman filter: moments of the model's values at points around the mean, without Jacobians.

    points:  X = x 1' + g L U,  L L' = P,  U = [0, I, -I]
    moments: of values Y, with D = [y_i - y_0], i = 1 ... 2n:  s = w D 1,  mean y_0 + s,  cov w D D' + b s s'
    predict: x, P = mean(f(X, u)), cov(f(X, u)) + Q
    update:  v = z - mean(h(X)),  S = cov(h(X)) + R,  K = w g L U h(X)' S^-1,  x += K v,
             P = w (g L U - K D) (g L U - K D)' + b K s (K s)' + K R K'

with g = alpha sqrt(n + kappa), w = 1/(2 g^2) and b = beta - alpha^2. The last line equals P - K S K'.

Source: Julier (2002), "The scaled unscented transformation".
"""

from __future__ import annotations

from numerics.algebra.densities import log_density
from numerics.algebra.operations import divide, of_best_gain, only, present, sym, uncorrelated, wrap
from numerics.algebra.points import first, ones, others, outer, root, square, units


def begin(model, x, P):
    """The points of a belief."""
    return points(model, x, root(P))


def points(model, x, L):
    """The mean, and the points around it."""
    g, _, _ = model.own
    return outer(x, ones(units(x))) + (L * g) @ units(x)


def moments(model, Y, angles):
    """Mean and shift of values at the points, and their deviations."""
    _, w, _ = model.own
    D = wrap(others(Y) - outer(first(Y), ones(others(Y))), angles)
    s = (D @ ones(D)) * w
    return first(Y) + s, s, D


def scatter(model, D, s):
    """The covariance of such deviations."""
    _, w, b = model.own
    return square(D) * w + outer(s, s) * b


def advance(model, X, u):
    """One of the model's substeps, of each point."""
    return model.f(X, u)


def settle(model, X):
    """The end of a step."""
    x, s, D = moments(model, X, model.state_angles)
    return wrap(x, model.state_angles), scatter(model, D, s) + model.Q


def update(model, x, P, z):
    """The measurement z; channels that are NaN are missing."""
    (g, w, _), L, U, seen = model.own, root(P), others(units(x)), present(z)
    y, s, D = moments(model, model.h(points(model, x, L)), model.measurement_angles)
    s, D, R = only(seen, s), only(seen, D), uncorrelated(seen, model.R)
    v = only(seen, wrap(z - y, model.measurement_angles))
    C = (L @ (U @ D.T)) * (w * g)
    S = scatter(model, D, s) + R
    K = divide(C, S)
    rest = scatter(model, (L * g) @ U - K @ D, K @ s) + sym(K @ R @ K.T)
    return wrap(x + K @ v, model.state_angles), of_best_gain(rest, P, C, S, K), v, S, log_density(v, S, seen)
