"""Operations of the UD form of a filter: factors U, D of P = U D U', in one matrix with D on its diagonal."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from filters.algebra.matrices import Operation, operation, same
from thruster_env.core.compiled import not_inlined
from thruster_env.core.sources import LONGEST_TEXT, Source
from thruster_env.graphs.graphs import where


@operation(same)
def unit_upper(ud):
    """U."""
    u = np.array(ud)
    for i in range(len(ud)):
        u[i, i], u[i, :i] = 1.0, 0.0
    return u


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
    """The factors of W diag(D, I) W', where I has as many rows as W has further columns."""
    n = len(ud)
    return _orthogonal(w, [ud[i, i] for i in range(n)] + [1.0] * (w.shape[1] - n))


def _orthogonal(w: np.ndarray, weights: list) -> np.ndarray:
    n, rows = len(w), [*np.array(w)]
    ud = np.full((n, n), 0.0, dtype=w.dtype)
    for j in reversed(range(n)):
        weighted = rows[j] * np.array(weights)
        d = weighted @ rows[j]
        vanishes = d <= 0.0
        ud[j, j], reciprocal = where(vanishes, 0.0, d), where(vanishes, 0.0, 1.0 / where(vanishes, 1.0, d))
        for i in range(j):
            ud[i, j] = (weighted @ rows[i]) * reciprocal
            rows[i] = rows[i] - ud[i, j] * rows[j]
    return ud


@operation(lambda ud, h: ud)
def measured_factors(ud, h):
    """The factors after an update by channels h (m, n), each with noise of variance one."""
    return _measured(ud, h)[0]


@operation(lambda ud, h: h[::-1])
def measured_gain(ud, h):
    """The gain (n, m) of `measured_factors`."""
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
        known = h[c] @ gain  # prediction of this channel by the earlier ones
        gain = gain - k[:, None] * known[None, :]
        gain[:, c] = gain[:, c] + k
    return ud, gain


# Operations of `upper` as functions for their sizes, for `calls`: loops over arrays, whatever the size.


@not_inlined
def called_unit_upper(ud):
    """U."""
    out = np.eye(len(ud))
    for i in range(len(ud)):
        for j in range(i + 1, len(ud)):
            out[i, j] = ud[i, j]
    return out


@not_inlined
def called_upper_root(ud):
    """U D^(1/2)."""
    out = np.zeros(ud.shape)
    for j in range(len(ud)):
        root = ud[j, j] ** 0.5
        for i in range(j):
            out[i, j] = ud[i, j] * root
        out[j, j] = root
    return out


@not_inlined
def called_weighted_factors(w, ud):
    """The factors of W diag(D, I) W', by Gram and Schmidt's method with these weights."""
    n, columns = w.shape
    rows, out, weights = w.copy(), np.zeros((n, n)), np.ones(columns)
    for i in range(len(ud)):
        weights[i] = ud[i, i]
    for j in range(n - 1, -1, -1):
        d = 0.0
        for k in range(columns):
            d += rows[j, k] * weights[k] * rows[j, k]
        if d <= 0.0:
            continue  # a row that vanishes has no component along others
        out[j, j] = d
        for i in range(j):
            total = 0.0
            for k in range(columns):
                total += rows[j, k] * weights[k] * rows[i, k]
            out[i, j] = total / d
            for k in range(columns):
                rows[i, k] -= out[i, j] * rows[j, k]
    return out


@not_inlined
def measured(ud, h):
    """`measured_factors` and `measured_gain`."""
    (m, n), updated, k = h.shape, ud.copy(), np.zeros(len(ud))
    gain = np.zeros((n, m))
    for c in range(m):
        before = 1.0
        for j in range(n):
            f = h[c, j]
            for i in range(j):
                f += updated[i, j] * h[c, i]
            g = updated[j, j] * f
            total = before + f * g
            updated[j, j] *= before / total
            for i in range(j):
                was = updated[i, j]
                updated[i, j] = was - k[i] * f / before
                k[i] += was * g
            k[j], before = g, total
        for j in range(n):
            k[j] /= before
        for d in range(c):
            known = 0.0
            for j in range(n):
                known += h[c, j] * gain[j, d]
            for j in range(n):
                gain[j, d] -= k[j] * known
        for j in range(n):
            gain[j, c] = k[j]
    return updated, gain


def _of_arrays(function: Callable, part: str = "", more: str = "") -> Callable:
    """Return `make(result, *shapes)`: a function of arrays as one of matrices, tuples or arrays by their sizes."""

    def make(result: tuple, *shapes: tuple) -> Callable:
        named = dict(zip("ab", shapes, strict=False))
        source = Source(function.__name__, ", ".join(named), result=result, work=LONGEST_TEXT + 1, **named)
        out = source.local("out", *result)
        source.line(f"out = work({', '.join(source.array_of(name) for name in named)}{more}){part}")
        names: dict[str, Any] = {"work": function}
        return source.function(source.all_entries(out), **names)

    return make


FUNCTIONS: dict[Operation, Callable] = {
    unit_upper: _of_arrays(called_unit_upper),
    upper_root: _of_arrays(called_upper_root),
    factors: _of_arrays(called_weighted_factors, more=", np.zeros((0, 0))"),
    weighted_factors: _of_arrays(called_weighted_factors),
    measured_factors: _of_arrays(measured, "[0]"),
    measured_gain: _of_arrays(measured, "[1]"),
}
