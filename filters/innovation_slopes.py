"""Derivatives of an innovation's log-likelihood along parameters, and the information in it."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache

from numerics.compiled import inlined
from numerics.matrices import innovation_likelihood, present_part, row_solver, vector_solver
from numerics.sources import Source
from numerics.tuples import matrix_writer, vector_writer


def noted(m: int) -> int:
    """Length of the row that `statistics_of` keeps of a parameter, for m measurements."""
    return 2 * m + m * m


@cache
def log_likelihood_slope(size: int) -> Callable:
    """`slope(v, dy, l, ds, z)`: of log N(v; 0, S) with S = l l', where v changes by -dy and S by ds.

    It is -1/2 tr(S^-1 dS) + w' dy + 1/2 w' dS w with w = S^-1 v, over the channels that are not NaN in z.
    """
    matrix, vector = (size, size), (size,)
    shapes = {"w": vector, "e": matrix, "dy": vector, "ds": matrix, "z": vector}
    source = Source("combine", "w, e, dy, ds, z", work=size * size, **shapes)
    products = (f"w[{i}] * ds[{i}][{j}] * w[{j}]" for i in source.range(size) for j in source.range(size))
    square = source.sum(products)
    trace = source.sum(f"(e[{i}][{i}] if z[{i}] == z[{i}] else 0.0)" for i in source.range(size))
    shift = source.sum(f"w[{i}] * dy[{i}]" for i in source.range(size))
    combine = source.function(f"0.5 * ({square} - ({trace})) + {shift}")
    divide_one, divide = vector_solver(size), row_solver(size, size)

    @inlined
    def slope(v, dy, root, ds, z):
        return combine(divide_one(v, root), divide(ds, root), dy, ds, z)

    return slope


@cache
def statistics_of(m: int) -> tuple[Callable, ...]:
    """The functions of `sensitivities.Parts` from `weigh` on, for Student-t innovations of covariance S.

    With q = v' S^-1 v over d channels and nu degrees of freedom, infinitely many for the normal density N,

        log t = log N + q/2 + d/2 log(2/(nu - 2)) + log G((nu + d)/2) - log G(nu/2)
                - (nu + d)/2 log(1 + q/(nu - 2)).

    What depends on v changes along a parameter by (nu + d)/(nu - 2 + q) times what it does for N. The
    information is that of N: I_ij = dy_i' S^-1 dy_j + 1/2 tr(S^-1 dS_i S^-1 dS_j).
    """
    normal, weigh, divide = innovation_likelihood(m), vector_solver(m), row_solver(m, m)
    normal_slope = log_likelihood_slope(m)
    source = Source("measure", "v, w, z", v=(m,), w=(m,), z=(m,))
    square = source.sum(f"v[{i}] * w[{i}]" for i in source.range(m))
    count = source.sum(f"(1.0 if z[{i}] == z[{i}] else 0.0)" for i in source.range(m))
    measure = source.function(f"({square}, {count})")
    mask, trace = present_part(m), _present_trace(m)
    store, store_weighted, store_ratio = vector_writer(m), vector_writer(m, m), matrix_writer(m, m, 2 * m)

    @inlined
    def log_likelihood(v, root, z, w, degrees):
        value = normal(v, root, z)
        if degrees < math.inf:
            q, d = measure(v, w, z)
            value += 0.5 * q + 0.5 * d * math.log(2.0 / (degrees - 2.0))
            value += math.lgamma(0.5 * (degrees + d)) - math.lgamma(0.5 * degrees)
            value -= 0.5 * (degrees + d) * math.log(1.0 + q / (degrees - 2.0))
        return value

    @inlined
    def slope(v, dy, root, ds, z, w, degrees):
        value = normal_slope(v, dy, root, ds, z)
        if degrees < math.inf:
            q, d = measure(v, w, z)
            half_trace = 0.5 * trace(divide(ds, root), z)
            value = (value + half_trace) * (degrees + d) / (degrees - 2.0 + q) - half_trace
        return value

    @inlined
    def note(row, dy, ds, root, z):
        store(row, dy)
        store_weighted(row, weigh(dy, root))
        store_ratio(row, divide(mask(ds, z), root))

    @inlined
    def sum_up(notes, information):
        for i in range(notes.shape[0]):
            for j in range(i + 1):
                total = 0.0
                for a in range(m):
                    total += notes[i, a] * notes[j, m + a]
                    for b in range(m):
                        total += 0.5 * notes[i, 2 * m + a * m + b] * notes[j, 2 * m + b * m + a]
                information[i, j] += total
                if j < i:
                    information[j, i] += total

    return weigh, log_likelihood, slope, note, sum_up


@cache
def _present_trace(m: int) -> Callable:
    """Return `trace(e, z)`: over the channels that are not NaN in z."""
    source = Source("trace", "e, z", e=(m, m), z=(m,))
    return source.function(source.sum(f"(e[{i}][{i}] if z[{i}] == z[{i}] else 0.0)" for i in source.range(m)))
