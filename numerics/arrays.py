"""Products and quotients of large matrices, as loops over arrays of float64 that run along contiguous memory.

They are compiled once for all sizes. Loops, and no calls of BLAS: its threads would compete with those that share
out trajectories, and its sums depend on the machine.
"""

from __future__ import annotations

import numpy as np

from numerics.compiled import inlined


def called(function):
    """Mark a function that compiled functions call; see `numerics.compiled.inlined`."""
    return inlined(function, into_callers=False)


@called
def product_of_rows(a, b):
    """A b', of arrays by rows: four rows of b at a time share what is read of a."""
    rows, columns, inner = a.shape[0], b.shape[0], a.shape[1]
    out = np.empty((rows, columns))
    whole = columns - columns % 4
    for i in range(rows):
        for j in range(0, whole, 4):
            s_0 = s_1 = s_2 = s_3 = 0.0
            for k in range(inner):
                x = a[i, k]
                s_0 += x * b[j, k]
                s_1 += x * b[j + 1, k]
                s_2 += x * b[j + 2, k]
                s_3 += x * b[j + 3, k]
            out[i, j] = s_0
            out[i, j + 1] = s_1
            out[i, j + 2] = s_2
            out[i, j + 3] = s_3
        for j in range(whole, columns):
            s_0 = 0.0
            for k in range(inner):
                s_0 += a[i, k] * b[j, k]
            out[i, j] = s_0
    return out


@called
def add_product(out, a, b):
    """Add a b to the first rows of an array: four rows of b at a time are added to a row of it."""
    rows, inner, columns = a.shape[0], b.shape[0], b.shape[1]
    whole = inner - inner % 4
    for i in range(rows):
        for k in range(0, whole, 4):
            x_0, x_1, x_2, x_3 = a[i, k], a[i, k + 1], a[i, k + 2], a[i, k + 3]
            for j in range(columns):
                out[i, j] += x_0 * b[k, j] + x_1 * b[k + 1, j] + x_2 * b[k + 2, j] + x_3 * b[k + 3, j]
        for k in range(whole, inner):
            x_0 = a[i, k]
            for j in range(columns):
                out[i, j] += x_0 * b[k, j]


@called
def product(a, b):
    """A b."""
    out = np.zeros((a.shape[0], b.shape[1]))
    add_product(out, a, b)
    return out


@called
def deviations(table, first, rows, means, size):
    """Distances from means (rows,) in so many rows of a table from the first on, and `size` columns."""
    out = np.empty((rows, size))
    for i in range(rows):
        for j in range(size):
            out[i, j] = table[first + i, j] - means[i]
    return out


@called
def weighted_square_of_rows(d, table, weights):
    """The sum of w d d' over columns d with weights w from a row of a table, exactly symmetric."""
    rows, size = d.shape
    scaled = np.empty((rows, size))
    for i in range(rows):
        for j in range(size):
            scaled[i, j] = table[weights, j] * d[i, j]
    out = np.empty((rows, rows))
    for i in range(rows):
        for j in range(i + 1):
            total = 0.0
            for k in range(size):
                total += scaled[i, k] * d[j, k]
            out[i, j] = out[j, i] = total
    return out


@called
def square_of_rows(a):
    """A a', exactly symmetric."""
    rows, inner = a.shape
    out = np.empty((rows, rows))
    for i in range(rows):
        for j in range(i + 1):
            total = 0.0
            for k in range(inner):
                total += a[i, k] * a[j, k]
            out[i, j] = out[j, i] = total
    return out


@called
def solve_rows(b, factor):
    """B (l l')^-1 for a lower triangular l: forwards with its rows, then backwards with them once more."""
    rows, size = b.shape
    out = b.copy()
    for r in range(rows):
        for i in range(size):
            total = out[r, i]
            for k in range(i):
                total -= factor[i, k] * out[r, k]
            out[r, i] = total / factor[i, i]
        for i in range(size - 1, -1, -1):
            x = out[r, i] / factor[i, i]
            out[r, i] = x
            for k in range(i):
                out[r, k] -= factor[i, k] * x
    return out
