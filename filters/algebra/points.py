"""Operations of sigma-point filters: the root of a covariance, and points as the columns of a matrix.

With L L' = P, the unit vectors U = [0, I, -I] and a vector 1 of ones, the points x, x + g L_i, x - g L_i are the
columns of x 1' + g L U.

Source of the root's derivative: Murray (2016), "Differentiation of the Cholesky decomposition", arXiv:1602.07527.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from filters.algebra.matrices import Operation, operation, plus, same, through
from filters.algebra.operations import of_constant, with_transposed
from thruster_env.core import matrices as matrix_functions
from thruster_env.core.angles import row_brancher, wrapped
from thruster_env.core.matrices import RESOLUTION
from thruster_env.core.sources import Source, entrywise, written_out
from thruster_env.graphs.graphs import arctan2, where

UNKNOWN = 1e-9  # largest slope of a zero pivot, relative to the entry of dP, at which the root has a derivative


@operation(same)
def root(p):
    """The lower triangular L with L L' = p; of a singular p it has zero columns, where pivots are rounding."""
    lower = np.full(p.shape, 0.0, dtype=p.dtype)
    for j in range(len(p)):
        d = p[j, j] - sum(lower[j, k] * lower[j, k] for k in range(j))
        singular = d <= RESOLUTION * p[j, j]
        pivot = where(singular, 1.0, d) ** 0.5
        lower[j, j], reciprocal = where(singular, 0.0, pivot), where(singular, 0.0, 1.0 / pivot)
        for i in range(j + 1, len(p)):
            lower[i, j] = (p[i, j] - sum(lower[i, k] * lower[j, k] for k in range(j))) * reciprocal
    return lower


@operation(same)
def root_slope(lower, dp):
    """The slope of the root L of P: L Phi(L^-1 dP L'^-1), where Phi is the lower triangle with half the diagonal.

    It is computed column by column, like the root; of a singular P it is NaN if dP leaves the range of P.
    """
    slope = np.full(dp.shape, 0.0, dtype=np.result_type(lower, dp))
    for j in range(len(dp)):
        singular = lower[j, j] == 0.0
        reciprocal = where(singular, 0.0, 1.0 / where(singular, 1.0, lower[j, j]))
        d = dp[j, j] - 2.0 * sum(lower[j, k] * slope[j, k] for k in range(j))
        lost = where(abs(d) > UNKNOWN * abs(dp[j, j]), math.nan, 0.0)
        slope[j, j] = where(singular, lost, 0.5 * d * reciprocal)
        for i in range(j + 1, len(dp)):
            known = sum(slope[i, k] * lower[j, k] + lower[i, k] * slope[j, k] for k in range(j))
            slope[i, j] = (dp[i, j] - known - lower[i, j] * slope[j, j]) * reciprocal
    return slope


@operation(lambda x: (x[0], 2 * x[0] + 1))
def units(x):
    """The columns [0, I, -I], with as many rows as the vector x."""
    identity = np.eye(len(x))
    return np.concatenate([np.zeros((len(x), 1)), identity, -identity], axis=1)


@operation(lambda a: a[1:])
def ones(a):
    """A vector of ones, one for each column of a matrix."""
    return np.ones(a.shape[1])


@operation(lambda a, b: (*a, *b), lambda a, b: a is b)
def outer(a, b):
    """The matrix a b' of two vectors."""
    return np.ravel(a)[:, None] * np.ravel(b)


@operation(lambda a: (a[0], a[0]), lambda a: True)
def square(a):
    """The symmetric matrix A A'."""
    return a @ a.T


@operation(lambda a: a[:1])
def first(a):
    """The first column of a matrix."""
    return a[:, 0]


@operation(lambda a: (a[0], a[1] - 1))
def without_first(a):
    """The columns of a matrix without the first."""
    return a[:, 1:]


@operation(lambda u, nodes: nodes)
def hats(u, nodes):
    """Weights (s,) of values at increasing nodes, for linear interpolation at u (1,)."""
    weights = []
    for s in range(len(nodes)):
        weight = 1.0
        if s > 0:
            weight = least(weight, (u[0] - nodes[s - 1]) / (nodes[s] - nodes[s - 1]))
        if s < len(nodes) - 1:
            weight = least(weight, (nodes[s + 1] - u[0]) / (nodes[s + 1] - nodes[s]))
        weights.append(where(0.0 < weight, weight, 0.0))
    return np.array(weights)


def least(a, b):
    """The smaller one of two numbers."""
    return where(b < a, b, a)


def on_circle(y, angles):
    """Columns with the rows of angles (flags) within half a turn of their circular mean."""
    return on_one_side(y, tuple(angles)) if any(angles) else y


@operation(same)
def on_one_side(y, angles):
    """`on_circle`, if there are angles."""

    def aligned(row):
        middle = arctan2(np.sin(row).sum(), np.cos(row).sum())
        return middle + wrapped(row - middle)

    return np.array([aligned(row) if angle else row for row, angle in zip(y, angles, strict=True)])


# Derivatives; slopes of None are zero

root.derivative(lambda result, arguments, slopes: through(lambda slope: root_slope(result, slope), slopes[0]))


@outer.derivative
def _of_outer(result, arguments, slopes):
    (a, b), (da, db) = arguments, slopes
    if a is b:
        return through(lambda slope: with_transposed(outer(slope, a)), da)
    return plus(through(lambda slope: outer(slope, b), da), through(lambda slope: outer(a, slope), db))


square.derivative(
    lambda result, arguments, slopes: through(lambda slope: with_transposed(slope @ arguments[0].T), slopes[0])
)

units.derivative(of_constant)
ones.derivative(of_constant)


@first.derivative
@without_first.derivative
@on_one_side.derivative
def _of_part(result, arguments, slopes):
    return through(lambda slope: slope if result.operation is on_one_side else result.operation(slope), slopes[0])


# Operations of `points` as functions that are made for their sizes, for `calls`.


def _root_slope(result: tuple, *of: tuple) -> Callable:
    n = result[0]
    source = Source("root_slope", "l, dp", result=result, l=result, dp=result, work=n**3 // 3)
    slope = source.local("s", n, n)
    for j in source.range(n):
        known = source.sum(f"l[{j}][{k}] * {slope[j, k]}" for k in source.range(j))
        source.line(f"d = dp[{j}][{j}] - 2.0 * ({known})")
        source.line(f"r = 1.0 / l[{j}][{j}] if l[{j}][{j}] != 0.0 else 0.0")
        lost = f"(nan if abs(d) > {UNKNOWN} * abs(dp[{j}][{j}]) else 0.0)"
        source.line(f"{slope[j, j]} = 0.5 * d * r if l[{j}][{j}] != 0.0 else {lost}")
        for i in source.range(j + 1, n):
            terms = (f"({slope[i, k]} * l[{j}][{k}] + l[{i}][{k}] * {slope[j, k]})" for k in source.range(j))
            rest = source.less(f"dp[{i}][{j}]", terms)
            source.line(f"{slope[i, j]} = ({rest} - l[{i}][{j}] * {slope[j, j]}) * r")
    return source.function(source.lower(slope), nan=math.nan)


def _units(result: tuple, x: tuple) -> Callable:
    source = Source("units", "x", result=result)

    def entry(i, j):
        below = source.if_same(j, i + (x[0] + 1), "-1.0", "0.0")
        return source.if_same(j, i + 1, "1.0", below)

    return source.function(source.entries(result, entry))


def _on_one_side(result: tuple, angles: tuple[bool, ...], of: tuple) -> Callable:
    turn, back = matrix_functions.transposer(*of), matrix_functions.transposer(*of[::-1])
    align = row_brancher(of[1], angles)
    return written_out("on_one_side", "y", "back(align(turn(y)))", turn=turn, back=back, align=align)


def _hats(result: tuple, u: tuple, nodes: tuple) -> Callable:
    source = Source("hats", "u, x", result=result, x=nodes)
    weights = source.local("w", *result)
    for s in range(*result):
        sides = [f"(u[0] - x[{s - 1}]) / (x[{s}] - x[{s - 1}])"] * (s > 0)
        sides += [f"(x[{s + 1}] - u[0]) / (x[{s + 1}] - x[{s}])"] * (s < result[0] - 1)
        source.line(f"{weights[s]} = max(0.0, min(1.0, {', '.join(sides)}))")
    return source.function(source.all_entries(weights))


FUNCTIONS: dict[Operation, Callable] = {
    root: lambda result, of: matrix_functions.semidefinite_factor(*result[:1]),
    root_slope: _root_slope,
    units: _units,
    ones: lambda result, of: entrywise("ones", "a", result, lambda i: "1.0"),
    outer: lambda result, a, b: entrywise("outer", "a, b", result, lambda i, j: f"a[{i}] * b[{j}]", a=a, b=b),
    square: lambda result, of: matrix_functions.square(*of),
    first: lambda result, of: entrywise("first", "a", result, lambda i: f"a[{i}][0]", a=of),
    without_first: lambda result, a: entrywise("rest", "a", result, lambda i, j: f"a[{i}][{j + 1}]", a=a),
    on_one_side: _on_one_side,
    hats: _hats,
}
