"""What pages of square-root and information filters say: inverses, orthogonal triangles, and blocks of matrices.

Filters in these forms are differentiated in the covariance form, so that most of them have no derivative.
"""

from __future__ import annotations

import math

import numpy as np

from filters.algebra.matrices import minus, operation, same, through
from filters.algebra.operations import factor, forward, mirrored, pivoted
from thruster_env.core.triangles import NEGLIGIBLE
from thruster_env.graphs.graphs import where


def inverse_of(s):
    """S^-1 of a covariance S."""
    return inverted(factor(s))


@operation(same, lambda of: True)
def inverted(of):
    """S^-1 = W' W of a factor of S, with W = d^(-1/2) L^-1: symmetric and positive by construction."""
    lower, d = of
    w = forward(np.array(np.eye(len(d)), dtype=d.dtype), lower).T  # L^-1
    return mirrored.compute((w.T * (1.0 / d)) @ w)


@operation(same)
def careful(s):
    """The factor of a positive semidefinite S, for `operations.quotient`, with which quotients are finite.

    Where a pivot is zero but for rounding d is infinite, so that dividing gives zero there. For a numerator in the
    range of S that is a solution: components known exactly have no share in a gain.
    """
    return pivoted(s, lambda d, variance: d > NEGLIGIBLE * variance, math.inf)


@operation(lambda a: (a[0], a[0]))
def triangle(a):
    """The lower triangular L with L L' = A A'; a row that depends on those above it has a zero there.

    Its rows are those of A in the basis that Gram and Schmidt's method makes of them: the modified method, whose
    L is as accurate as Householder's. Source: Bjorck (1967), "Solving linear least squares problems by
    Gram-Schmidt orthogonalization".
    """
    rows, lower = [row for row in np.array(a)], np.full((len(a), len(a)), 0.0, dtype=a.dtype)
    for i, row in enumerate(rows):
        square = row @ row
        vanishes = square <= 0.0
        length = where(vanishes, 1.0, square) ** 0.5
        lower[i, i], direction = where(vanishes, 0.0, length), row * where(vanishes, 0.0, 1.0 / length)
        for k in range(i + 1, len(rows)):
            lower[k, i] = direction @ rows[k]
            rows[k] = rows[k] - lower[k, i] * direction
    return lower


@operation(lambda a, b: (a[0], a[1] + b[1]))
def hstack(a, b):
    """The matrix [A, B]."""
    return np.concatenate([a, b], axis=1)


@operation(lambda a, b: (a[0] + b[0], a[1]))
def vstack(a, b):
    """The matrix [A; B]."""
    return np.concatenate([a, b])


@operation(lambda a, top, left, rows, columns: (rows, columns))
def part(a, top, left, rows, columns):
    """The block of so many rows and columns whose first entry stands at (top, left)."""
    return a[top : top + rows, left : left + columns]


@operation(
    lambda a, rows, columns: (len(rows), len(columns)), lambda a, rows, columns: a.symmetric and rows == columns
)
def pick(a, rows, columns):
    """These rows and columns of a matrix, in this order."""
    return a[np.ix_(rows, columns)]


@operation(lambda a, *shape: shape)
def zeros(a, *shape):
    """A matrix or vector of zeros, beside another one."""
    return np.zeros(shape)


@operation(lambda lower, v: v)
def forward_quotient(lower, v):
    """L^-1 v of a lower triangular L."""
    found = np.array(v)
    for i in range(len(v)):
        found[i] = (found[i] - sum(lower[i, k] * found[k] for k in range(i))) / lower[i, i]
    return found


@operation(same)
def triangle_quotient(a, lower):
    """A L^-1 of a lower triangular L."""
    found = np.array(a, dtype=np.result_type(a, lower))
    for i in reversed(range(len(lower))):
        rest = found[:, i] - sum(found[:, k] * lower[k, i] for k in range(i + 1, len(lower)))
        found[:, i] = rest * (1.0 / lower[i, i])
    return found


@operation(same)
def factor_of(lower):
    """The factor of S = L L', as `operations.factor` makes it of S."""
    d = np.diag(lower)
    return lower * (1.0 / d)[None, :], d * d


@forward_quotient.derivative
def _of_forward_quotient(result, arguments, slopes):
    """The slope L^-1 (dv - dL y) of y = L^-1 v."""
    (lower, _), (dl, dv) = arguments, slopes
    change = minus(dv, through(lambda slope: slope @ result, dl))
    return through(lambda slope: forward_quotient(lower, slope), change)
