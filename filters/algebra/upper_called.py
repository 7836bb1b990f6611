"""Operations of `upper` as functions for their sizes, for `calls`: loops over arrays, whatever the size."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from filters.algebra import upper
from filters.algebra.matrices import Operation
from thruster_env.core.compiled import not_inlined
from thruster_env.core.sources import LONGEST_TEXT, Source


@not_inlined
def unit_upper(ud):
    """U."""
    out = np.eye(len(ud))
    for i in range(len(ud)):
        for j in range(i + 1, len(ud)):
            out[i, j] = ud[i, j]
    return out


@not_inlined
def upper_root(ud):
    """U D^(1/2)."""
    out = np.zeros(ud.shape)
    for j in range(len(ud)):
        root = ud[j, j] ** 0.5
        for i in range(j):
            out[i, j] = ud[i, j] * root
        out[j, j] = root
    return out


@not_inlined
def weighted_factors(w, ud):
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
            continue  # a row that vanishes is along no other
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
def factors(w):
    """The factors of W W'."""
    return weighted_factors(w, np.zeros((0, 0)))


@not_inlined
def measured(ud, h):
    """The factors after channels h (m, n), each with noise of variance one, and the gain (n, m)."""
    (m, n), found, k = h.shape, ud.copy(), np.zeros(len(ud))
    gain = np.zeros((n, m))
    for c in range(m):
        before = 1.0
        for j in range(n):
            f = h[c, j]
            for i in range(j):
                f += found[i, j] * h[c, i]
            g = found[j, j] * f
            total = before + f * g
            found[j, j] *= before / total
            for i in range(j):
                was = found[i, j]
                found[i, j] = was - k[i] * f / before
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
    return found, gain


def _of_arrays(function: Callable, part: str = "") -> Callable:
    """What makes functions of matrices, tuples or arrays as their sizes say, from one of arrays."""

    def make(result: tuple, *shapes: tuple) -> Callable:
        named = dict(zip("ab", shapes, strict=False))
        source = Source(function.__name__, ", ".join(named), result=result, work=LONGEST_TEXT + 1, **named)
        found = source.local("found", *result)
        source.line(f"found = work({', '.join(source.array_of(name) for name in named)}){part}")
        names: dict[str, Any] = {"work": function}
        return source.function(source.whole(found), **names)

    return make


FUNCTIONS: dict[Operation, Callable] = {
    upper.unit_upper: _of_arrays(unit_upper),
    upper.upper_root: _of_arrays(upper_root),
    upper.factors: _of_arrays(factors),
    upper.weighted_factors: _of_arrays(weighted_factors),
    upper.measured_factors: _of_arrays(measured, "[0]"),
    upper.measured_gain: _of_arrays(measured, "[1]"),
}
