"""Products and quotients of large matrices, as loops over arrays of float64 that run along contiguous memory.

They are compiled once for all sizes. They are loops rather than calls of BLAS, because the threads of BLAS would
compete with those that work on different trajectories, and because its sums depend on the machine.
"""

from __future__ import annotations

import numpy as np

from thruster_env.core.compiled import inlined, not_inlined


def called(function):
    """Mark a function that compiled functions call; see `thruster_env.core.compiled.inlined`."""
    return inlined(function, into_callers=False)


@not_inlined
def _products_of_rows(a, b, lower):
    """A b', or its part on and below the diagonal, in blocks of two rows of a and four of b that share reads.

    Blocks at the ends repeat the last row, so that no further loops are needed for the remainder.
    """
    rows, columns, inner = a.shape[0], b.shape[0], a.shape[1]
    out = np.empty((rows, columns))
    for i in range(0, rows, 2):
        i_1 = min(i + 1, rows - 1)
        for j in range(0, i + 2 if lower else columns, 4):
            j_0, j_1, j_2, j_3 = (
                min(j, columns - 1),
                min(j + 1, columns - 1),
                min(j + 2, columns - 1),
                min(j + 3, columns - 1),
            )
            p_0 = p_1 = p_2 = p_3 = q_0 = q_1 = q_2 = q_3 = 0.0
            for k in range(inner):
                x, y = a[i, k], a[i_1, k]
                p_0 += x * b[j_0, k]
                p_1 += x * b[j_1, k]
                p_2 += x * b[j_2, k]
                p_3 += x * b[j_3, k]
                q_0 += y * b[j_0, k]
                q_1 += y * b[j_1, k]
                q_2 += y * b[j_2, k]
                q_3 += y * b[j_3, k]
            out[i, j_0], out[i, j_1], out[i, j_2], out[i, j_3] = p_0, p_1, p_2, p_3
            out[i_1, j_0], out[i_1, j_1], out[i_1, j_2], out[i_1, j_3] = q_0, q_1, q_2, q_3
    return out


@not_inlined
def product_of_rows(a, b):
    """A b'."""
    return _products_of_rows(a, b, False)


@not_inlined
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


@not_inlined
def sparse_product(a, b):
    """A b; where four entries of a that lie side by side are zero, nothing is added."""
    out = np.zeros((a.shape[0], b.shape[1]))
    for i in range(a.shape[0]):
        for first in range(0, a.shape[1], 4):
            last = min(first + 4, a.shape[1])
            anything = False
            for k in range(first, last):
                anything = anything or a[i, k] != 0.0
            if anything and last == first + 4:
                x_0, x_1, x_2, x_3 = a[i, first], a[i, first + 1], a[i, first + 2], a[i, first + 3]
                for j in range(b.shape[1]):
                    out[i, j] += (
                        x_0 * b[first, j] + x_1 * b[first + 1, j] + x_2 * b[first + 2, j] + x_3 * b[first + 3, j]
                    )
            elif anything:
                for k in range(first, last):
                    for j in range(b.shape[1]):
                        out[i, j] += a[i, k] * b[k, j]
    return out


@not_inlined
def deviations(table, first, rows, means, size):
    """Deviations from means (rows,) of `rows` rows of a table, starting at row `first`, and `size` columns."""
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
    out = _products_of_rows(scaled, d, True)
    for i in range(rows):
        for j in range(i):
            out[j, i] = out[i, j]
    return out


@not_inlined
def square_of_rows(a):
    """A a', exactly symmetric."""
    out = _products_of_rows(a, a, True)
    for i in range(a.shape[0]):
        for j in range(i):
            out[j, i] = out[i, j]
    return out


@not_inlined
def solve_rows(b, factor):
    """B (l l')^-1 for a lower triangular l: forward, then backward substitution for all rows of b at a time."""
    rows, size = b.shape
    turned = b.T.copy()
    for i in range(size):
        for k in range(i):
            x = factor[i, k]
            for r in range(rows):
                turned[i, r] -= x * turned[k, r]
        for r in range(rows):
            turned[i, r] /= factor[i, i]
    for i in range(size - 1, -1, -1):
        for k in range(i + 1, size):
            x = factor[k, i]
            for r in range(rows):
                turned[i, r] -= x * turned[k, r]
        for r in range(rows):
            turned[i, r] /= factor[i, i]
    return turned.T.copy()
