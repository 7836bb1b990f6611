"""What the UD form of a filter says: factors U, D of P = U D U', in one matrix with D on its diagonal."""

from __future__ import annotations

import numpy as np

from filters.algebra.matrices import operation, same
from thruster_env.graphs.graphs import where


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
        before, k = 1.0, np.full(n, 0.0, dtype=ud.dtype)
        for j in range(n):
            g = ud[j, j] * f[j]
            total = before + f[j] * g
            ud[j, j] = ud[j, j] * before / total
            for i in range(j):
                was = ud[i, j]
                ud[i, j] = was - k[i] * f[j] / before
                k[i] = k[i] + was * g
            k[j], before = g, total
        k = k / before
        known = h[c] @ gain  # what the channels before say of this one
        gain = gain - k[:, None] * known[None, :]
        gain[:, c] = gain[:, c] + k
    return ud, gain
