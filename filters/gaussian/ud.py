"""The UD form of the Kalman filter: a unit upper triangular U and a diagonal D with P = U D U' are carried.

    predict: U D U' = [F U, Q^(1/2)] diag(D, I) [F U, Q^(1/2)]',  by Gram and Schmidt's method with these weights
    update:  one channel of R^(-1/2) z after the other, each a scalar whose noise has variance one

It has the digits of the square-root form. Both factors lie in one matrix, D on its diagonal. There are programs of
it only: the model's functions must be such that can be traced, and its states not more than some twenty.

Source: Bierman (1977), Factorization Methods for Discrete Sequential Estimation, chapter V; Thornton (1976),
"Triangular covariance factorizations for Kalman filtering".
"""

from __future__ import annotations

import numpy as np

from filters.pages.page import Page
from thruster_env.numerics.algebra.blocks import factor_of, forward_quotient, hstack, triangle
from thruster_env.numerics.algebra.densities import density
from thruster_env.numerics.algebra.graphs import where
from thruster_env.numerics.algebra.matrices import operation, same
from thruster_env.numerics.algebra.operations import only, present, uncorrelated, wrap
from thruster_env.numerics.algebra.points import root, square


def start(model):
    """The factors of the prior covariance."""
    return {"UD": factors(model.prior_root)}


def begin(model, x, P):
    """The mean and U; D stays where it is."""
    return x, unit_upper(model.kept["UD"])


def advance(model, x, U, u):
    """One of the model's substeps."""
    return wrap(model.f(x, u), model.state_angles), model.F(x, u) @ U


def settle(model, x, U):
    """The end of a step."""
    UD = weighted_factors(hstack(U, model.Q_root), model.kept["UD"])
    return x, square(upper_root(UD)), {"UD": UD}


def update(model, x, P, z):
    """The measurement z; channels that are NaN are missing."""
    seen, UD = present(z), model.kept["UD"]
    H, R_root = only(seen, model.H(x)), root(uncorrelated(seen, model.R))
    v = only(seen, wrap(z - model.h(x), model.measurement_angles))
    white = forward_quotient(R_root, H)
    of_s = triangle(hstack(R_root, H @ upper_root(UD)))
    x = wrap(x + measured_gain(UD, white) @ forward_quotient(R_root, v), model.state_angles)
    UD = measured_factors(UD, white)
    return x, square(upper_root(UD)), v, square(of_s), density(v, factor_of(of_s), seen), {"UD": UD}


@operation(same)
def unit_upper(ud):
    """U."""
    found = np.array(ud)
    for i in range(len(ud)):
        found[i, i], found[i, :i] = 1.0, 0.0
    return found


@operation(same)
def upper_root(ud):
    """The upper triangular U D^(1/2), whose square is P."""
    return unit_upper.compute(ud) * np.array([ud[i, i] ** 0.5 for i in range(len(ud))])[None, :]


@operation(same)
def factors(w):
    """The factors of W W', of a square W."""
    return _orthogonal(w, [1.0] * w.shape[1])


@operation(lambda w, ud: ud)
def weighted_factors(w, ud):
    """The factors of W diag(D, I) W', of as many ones as W has further columns."""
    n = len(ud)
    return _orthogonal(w, [ud[i, i] for i in range(n)] + [1.0] * (w.shape[1] - n))


def _orthogonal(w: np.ndarray, weights: list) -> np.ndarray:
    n, rows = len(w), [row for row in np.array(w)]
    found = np.full((n, n), 0.0, dtype=w.dtype)
    for j in reversed(range(n)):
        weighted = rows[j] * np.array(weights)
        d = weighted @ rows[j]
        vanishes = d <= 0.0
        found[j, j], reciprocal = where(vanishes, 0.0, d), where(vanishes, 0.0, 1.0 / where(vanishes, 1.0, d))
        for i in range(j):
            found[i, j] = (weighted @ rows[i]) * reciprocal
            rows[i] = rows[i] - found[i, j] * rows[j]
    return found


@operation(lambda ud, h: ud)
def measured_factors(ud, h):
    """The factors after the channels h (m, n), each with noise of variance one."""
    return _measured(ud, h)[0]


@operation(lambda ud, h: h[::-1])
def measured_gain(ud, h):
    """The gain of these channels, (n, m)."""
    return _measured(ud, h)[1]


def _measured(ud: np.ndarray, h: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    n, m = len(ud), len(h)
    ud, gain = np.array(ud), np.full((n, m), 0.0, dtype=ud.dtype)
    for c in range(m):
        f = [h[c, j] + sum(ud[i, j] * h[c, i] for i in range(j)) for j in range(n)]
        vstack, k = 1.0, np.full(n, 0.0, dtype=ud.dtype)
        for j in range(n):
            g = ud[j, j] * f[j]
            total = vstack + f[j] * g
            ud[j, j] = ud[j, j] * vstack / total
            for i in range(j):
                was = ud[i, j]
                ud[i, j] = was - k[i] * f[j] / vstack
                k[i] = k[i] + was * g
            k[j], vstack = g, total
        k = k / vstack
        known = h[c] @ gain  # what the channels before say of this one
        gain = gain - k[:, None] * known[None, :]
        gain[:, c] = gain[:, c] + k
    return ud, gain


UD = Page(advance, settle, update, begin, start)
