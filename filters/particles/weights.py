"""Weighted samples as rows of a table: weights from their logarithms, weighted moments, systematic resampling."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache

import numpy as np

from thruster_env.numerics import arrays
from thruster_env.numerics.compiled import inlined
from thruster_env.numerics.sources import Source, entrywise, lower_pairs
from thruster_env.numerics.tuples import column_reader, column_writer

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
    source = Source("means", "table, size", result=(rows,))
    each, w = [f"w = table[{weights}, j]"], f"table[{weights}, j]" if source.loops else "w"
    totals = source.totals("size", rows, lambda i: f"{w} * table[{first + i}, j]", each)
    return source.function(source.whole(totals))


@cache
def weighted_covariances(first: int, rows: int, weights: int) -> Callable:
    """Return `covariances(table, size, means)`: weighted sample covariance of rows first, first + 1, ...

    It is sum of w (x - mean)(x - mean)' over 1 - sum of w^2, which is unbiased for weights that do not depend on
    x; for equal ones the divisor is N - 1. Where one weight is all, it is what the others say.
    """
    source = Source("covariances", "table, size, means", result=(rows, rows), means=(rows,))
    # 1 - sum of w^2 is the sum of w (1 - w). For a weight near 1 the others tell 1 - w without cancellation.
    source.line("rest = others = 0.0")
    each = [
        f"w = table[{weights}, j]",
        "other = w if w <= 0.5 else 0.0",
        "others += other",
        "rest += other * (1.0 - other)",
    ]
    if source.loops:
        for _ in source.inside("for j in range(size):"):
            for text in each:
                source.line(text)
        source.line("rest += others * (1.0 - others)")
        source.line(f"d = deviations(table, {first}, {rows}, {source.array_of('means')}, size)")
        source.line(f"sums = weighted_square_of_rows(d, table, {weights})")
        names = {"deviations": arrays.deviations, "weighted_square_of_rows": arrays.weighted_square_of_rows}
        return source.function(source.matrix(rows, rows, lambda i, j: f"sums[{i}, {j}] / rest"), **names)
    each += [f"d{i} = table[{first + i}, j] - means[{i}]" for i in range(rows)]
    totals = source.totals("size", lower_pairs(rows), lambda i, j: f"w * d{i} * d{j}", each)
    source.line("rest += others * (1.0 - others)")
    return source.function(source.matrix(rows, rows, lambda i, j: f"{totals[max(i, j), min(i, j)]} / rest"))


@cache
def weighted_squares(first: int, rows: int, weights: int) -> Callable:
    """Return `squares(table, size)`: sum of w x x' over rows first, first + 1, ..."""
    source = Source("squares", "table, size", result=(rows, rows))
    if source.loops:
        source.line(f"d = deviations(table, {first}, {rows}, np.zeros({rows}), size)")
        source.line(f"sums = weighted_square_of_rows(d, table, {weights})")
        names = {"deviations": arrays.deviations, "weighted_square_of_rows": arrays.weighted_square_of_rows}
        return source.function(source.matrix(rows, rows, lambda i, j: f"sums[{i}, {j}]"), **names)

    def term(i, j):
        return f"table[{weights}, j] * table[{first + i}, j] * table[{first + j}, j]"

    return source.function(source.mirrored(source.totals("size", lower_pairs(rows), term)))


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
    kept = entrywise("kept", "array, j", (rows,), lambda i: f"array[{i + scratch}, j]")
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
