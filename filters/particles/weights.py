"""Weighted samples as rows of a table: weights from their logarithms, weighted moments, systematic resampling."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache

import numpy as np

from numerics.compiled import inlined
from numerics.tuples import column_reader, column_writer, matrix_of, tuple_of, written_out

_LOWEST = -46.0  # e^-46 = 1e-20 is nothing beside 1, and still tells how far the others are off
_LN_2, _PER_LN_2 = math.log(2.0), 1.0 / math.log(2.0)
_ROUNDER = 1.5 * 2.0**52  # adding it leaves the nearest whole number in the last bits
_ROUNDER_BITS = int(np.float64(_ROUNDER).view(np.int64))


@inlined
def exponential(x):
    """e^x for x <= 700, as e^-46 below -46 and for NaN; no branch or library call, so that loops vectorise.

    x = k log 2 + r with |r| <= log(2)/2; e^r by its series, to 1e-16, and 2^k by the exponent's bits.
    """
    x = x if x > _LOWEST else _LOWEST
    k = np.float64(x * _PER_LN_2 + _ROUNDER).view(np.int64) - _ROUNDER_BITS
    r = x - np.float64(k) * _LN_2
    series = 1.0 / 6227020800.0
    series = series * r + 1.0 / 479001600.0
    series = series * r + 1.0 / 39916800.0
    series = series * r + 1.0 / 3628800.0
    series = series * r + 1.0 / 362880.0
    series = series * r + 1.0 / 40320.0
    series = series * r + 1.0 / 5040.0
    series = series * r + 1.0 / 720.0
    series = series * r + 1.0 / 120.0
    series = series * r + 1.0 / 24.0
    series = series * r + 1.0 / 6.0
    series = series * r + 0.5
    series = series * r + 1.0
    series = series * r + 1.0
    return series * np.int64((k + 1023) << 52).view(np.float64)


@inlined
def read_weights(table, logarithms, weights, size):
    """Set the row `weights` from the row of their logarithms, which are normalised already."""
    for j in range(size):
        table[weights, j] = exponential(table[logarithms, j])


@inlined
def normalise(table, logarithms, weights, size):
    """Weights that sum to one, from a row of their logarithms; returns (log of the former sum, ESS).

    The row `logarithms` is shifted by the sum, the row `weights` set. The effective sample size ESS is
    1/sum of squared weights (Kong, Liu, Wong 1994). If no logarithm is above -inf, all becomes NaN.
    """
    top = -math.inf
    for j in range(size):
        top = table[logarithms, j] if table[logarithms, j] > top else top
    if not top > -math.inf:
        for j in range(size):
            table[weights, j] = table[logarithms, j] = math.nan
        return math.nan, math.nan
    total, squares = 0.0, 0.0
    for j in range(size):
        w = exponential(table[logarithms, j] - top)
        table[weights, j] = w
        total += w
        squares += w * w
    shift, scale = top + math.log(total), 1.0 / total
    for j in range(size):
        table[weights, j] *= scale
        table[logarithms, j] -= shift
    return shift, total * total / squares


@cache
def weighted_means(first: int, rows: int, weights: int) -> Callable:
    """Return `means(table, size)`: of rows first, first + 1, ..., with the weights in row `weights`."""
    return written_out(
        "means",
        "table, size",
        *(f"s{i} = 0.0" for i in range(rows)),
        "for j in range(size):",
        f"    w = table[{weights}, j]",
        *(f"    s{i} += w * table[{first + i}, j]" for i in range(rows)),
        tuple_of(f"s{i}" for i in range(rows)),
    )


@cache
def weighted_covariances(first: int, rows: int, weights: int) -> Callable:
    """Return `covariances(table, size, means)`: weighted sample covariance of rows first, first + 1, ...

    It is sum of w (x - mean)(x - mean)' over 1 - sum of w^2, which is unbiased for weights that do not depend on
    x; for equal ones the divisor is N - 1. Where one weight is all, it is what the others say.
    """
    pairs = [(i, j) for i in range(rows) for j in range(i + 1)]
    return written_out(
        "covariances",
        "table, size, means",
        # 1 - sum of w^2 is the sum of w (1 - w). For a weight near 1 the others tell 1 - w without cancellation.
        "rest = others = 0.0",
        *(f"s{i}_{j} = 0.0" for i, j in pairs),
        "for j in range(size):",
        f"    w = table[{weights}, j]",
        "    other = w if w <= 0.5 else 0.0",
        "    others += other",
        "    rest += other * (1.0 - other)",
        *(f"    d{i} = table[{first + i}, j] - means[{i}]" for i in range(rows)),
        *(f"    s{i}_{j} += w * d{i} * d{j}" for i, j in pairs),
        "rest += others * (1.0 - others)",
        matrix_of(rows, rows, lambda i, j: f"s{max(i, j)}_{min(i, j)} / rest"),
    )


@cache
def weighted_squares(first: int, rows: int, weights: int) -> Callable:
    """Return `squares(table, size)`: sum of w x x' over rows first, first + 1, ..."""
    pairs = [(i, j) for i in range(rows) for j in range(i + 1)]
    return written_out(
        "squares",
        "table, size",
        *(f"s{i}_{j} = 0.0" for i, j in pairs),
        "for j in range(size):",
        *(
            f"    s{i}_{j} += table[{weights}, j] * table[{first + i}, j] * table[{first + j}, j]"
            for i, j in pairs
        ),
        matrix_of(rows, rows, lambda i, j: f"s{max(i, j)}_{min(i, j)}"),
    )


@cache
def systematic_resampler(rows: int, weights: int, scratch: int) -> Callable:
    """Return `resample(table, size, u)`: rows 0 ... rows - 1 of N columns drawn by weight, for u in (0, 1).

    New column j is the old column i in whose weight (u + j)/N of the sum of weights lies: i is drawn N w_i times
    rounded up or down, and N w_i times on average. Rows scratch ... scratch + rows + 1 are written over; what
    pads the table becomes a copy of the first column.

    Source: Kitagawa (1996), "Monte Carlo filter and smoother for non-Gaussian nonlinear state space models",
    J. Computational and Graphical Statistics 5(1), appendix.
    """
    read, store, keep = column_reader(rows), column_writer(rows), column_writer(rows, scratch)
    kept = written_out("kept", "array, j", tuple_of(f"array[{scratch + i}, j]" for i in range(rows)))
    sums, parents = scratch + rows, scratch + rows + 1

    @inlined
    def resample(table, size, u):
        total = 0.0
        for i in range(size):
            total += table[weights, i]
            table[sums, i] = total
            table[parents, i] = 0.0
        if not total > 0.0:
            return
        # Where old column i starts among the new ones. One that is not drawn starts where the next one does,
        # which writes over it: without a branch on chance this takes a third of the time.
        parts = size / total
        for i in range(1, size):
            first = int(table[sums, i - 1] * parts - u + 1.0)
            if first < size:
                table[parents, first] = i
        parent = 0.0
        for j in range(size):
            parent = table[parents, j] if table[parents, j] > parent else parent
            table[parents, j] = parent
        for j in range(size):
            keep(table, j, read(table, int(table[parents, j])))
        for j in range(size):
            store(table, j, kept(table, j))
        for j in range(size, table.shape[1]):
            store(table, j, kept(table, 0))

    return resample


@cache
def log_density(m: int) -> tuple[Callable, Callable]:
    """Functions `half_square(v, l, z)` and `constant(l, z)`: log N(v; 0, l l') = constant - half_square.

    Channels that are NaN in z are left out; l must be the factor of a covariance without correlations to them.
    """
    lines = []
    for i in range(m):
        rest = "".join(f" - l[{i}][{k}] * y{k}" for k in range(i))
        lines.append(f"y{i} = (v[{i}]{rest}) / l[{i}][{i}] if z[{i}] == z[{i}] else 0.0")
    half_square = written_out(
        "half_square", "v, l, z", *lines, "0.5 * (" + " + ".join(f"y{i} * y{i}" for i in range(m)) + ")"
    )
    parts = (
        f"(-log(l[{i}][{i}]) - {0.5 * math.log(2.0 * math.pi)!r} if z[{i}] == z[{i}] else 0.0)" for i in range(m)
    )
    return half_square, written_out("constant", "l, z", " + ".join(parts), log=math.log)
