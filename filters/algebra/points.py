"""Operations of sigma-point and particle filters: roots of covariances, points, weights and log densities.

With L L' = P, the unit vectors U = [0, I, -I] and a vector 1 of ones, the points x, x + g L_i, x - g L_i are the
columns of x 1' + g L U. A particle's x is a vector for each member, its weight or the logarithm of it a number for
each member; in NumPy these are arrays (n, N) and (N,). Log densities have the derivative

    d log N(v; 0, S) = -w' dv + 1/2 tr((w w' - S^-1) dS),  w = S^-1 v

Missing channels have v = 0 and no correlations in S, so they do not contribute.

Source of the root's derivative: Murray (2016), "Differentiation of the Cholesky decomposition", arXiv:1602.07527.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from filters.algebra.matrices import Operation, minus, operation, plus, same, through
from filters.algebra.operations import (
    factor,
    forward,
    inverse,
    logarithm,
    mirrored,
    of_constant,
    quotient,
    with_transposed,
)
from thruster_env.core import matrices
from thruster_env.core.angles import row_brancher, wrapped
from thruster_env.core.matrices import RESOLUTION
from thruster_env.core.sources import Source, entrywise, written_out
from thruster_env.core.streams import LOWEST, parts
from thruster_env.graphs.graphs import Number, arctan2, largest_of_members, over_members, where

UNKNOWN = 1e-9  # largest slope of a zero pivot, relative to the entry of dP, at which the root has a derivative
LEVEL = 0.5 * math.log(2.0 * math.pi)


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
    turn, back = matrices.transposer(*of), matrices.transposer(*of[::-1])
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
    root: lambda result, of: matrices.semidefinite_factor(*result[:1]),
    root_slope: _root_slope,
    units: _units,
    ones: lambda result, of: entrywise("ones", "a", result, lambda i: "1.0"),
    outer: lambda result, a, b: entrywise("outer", "a, b", result, lambda i, j: f"a[{i}] * b[{j}]", a=a, b=b),
    square: lambda result, of: matrices.square(*of),
    first: lambda result, of: entrywise("first", "a", result, lambda i: f"a[{i}][0]", a=of),
    without_first: lambda result, a: entrywise("rest", "a", result, lambda i, j: f"a[{i}][{j + 1}]", a=a),
    on_one_side: _on_one_side,
    hats: _hats,
}


@operation(same)
def weights(logarithms):
    """e^l of l, at least -46: e^-46 is negligible beside 1. NaN becomes e^-46, too."""
    if not isinstance(logarithms, Number):
        return np.exp(np.where(logarithms > LOWEST, logarithms, LOWEST))
    series, power = parts(where(logarithms > LOWEST, logarithms, LOWEST))
    return series * power.graph.make("two_to", power)


@operation(same, reduces=True)
def total(a):
    """The sum over the members of a number."""
    return over_members(a) if isinstance(a, Number) else a.sum()


@operation(lambda a, w: a, lambda a, w: a.symmetric, reduces=True)
def weighted_mean(a, w):
    """The sum of w a over the members, for vectors or matrices a."""
    if a.dtype != object:
        return (a * w).sum(axis=-1, keepdims=True)
    return np.array([over_members(entry * w) for entry in a.ravel()], dtype=object).reshape(a.shape)


@operation(same, reduces=True)
def largest(a):
    """The largest of the members' numbers, without NaN; NaN if none is above -inf."""
    most = largest_of_members(a) if isinstance(a, Number) else np.fmax.reduce(a, initial=-math.inf)
    return where(most > -math.inf, most, math.nan)


def normalised(logarithms):
    """Weights that sum to one, proportional to e^l, and the logarithm of the sum of all e^l.

    The latter is NaN if no l is above -inf.
    """
    top = largest(logarithms)
    scaled = weights(logarithms - top)
    scale = total(scaled)
    return scaled / scale, top + logarithm(scale)


@operation(same, reduces=True)
def effective_size(w):
    """The ESS 1/sum of w^2 of weights that sum to one (Kong, Liu, Wong 1994)."""
    return 1.0 / total.compute(w * w)


@operation(lambda d, w: (*d, *d), lambda d, w: True, reduces=True)
def weighted_square(d, w):
    """The sum of w d d' over the members."""
    if d.dtype != object:
        return (d * w) @ d.T
    scaled = w * d
    return mirrored.compute(np.array([[over_members(first * other) for other in d] for first in scaled]))


@operation(same, reduces=True)
def spread_share(w):
    """1 less the sum of the squares of weights that sum to one, as the sum of w (1 - w).

    For a weight above 1/2, 1 - w is the sum of the others, which avoids cancellation.
    """
    minor = where(w > 0.5, 0.0, w) if isinstance(w, Number) else np.where(w > 0.5, 0.0, w)
    rest = total.compute(minor)
    return total.compute(minor * (1.0 - minor)) + rest * (1.0 - rest)


def weighted_covariance(x, w):
    """The sample covariance: the sum of w (x - mean)(x - mean)' over 1 - sum of w^2.

    It is unbiased for weights that do not depend on x; for equal ones the divisor is N - 1.
    """
    return weighted_square(x - weighted_mean(x, w), w) / spread_share(w)


# Log densities of innovations, and their derivatives along a parameter.


def log_density(v, s, measured):
    """The number log N(v; 0, S) over the measured channels."""
    return density(v, factor(s), measured)


@operation(lambda *shapes: ())
def density(v, of, measured):
    """`log_density`, from the factor of S."""
    lower, d = of
    y = forward(np.ravel(v), lower)
    logs = (where(measured[i], 0.5 * np.log(d[i]) + LEVEL, 0.0) for i in range(len(d)))
    return -sum(0.5 * y[i] * y[i] / d[i] for i in range(len(d))) - sum(logs)


@operation(lambda *shapes: ())
def dot(a, b):
    """The product a' b of vectors."""
    return np.ravel(a) @ np.ravel(b)


@operation(lambda *shapes: ())
def half_trace(w, other, e, ds):
    """1/2 tr((w other' - e) dS), the slope of a log density along a covariance."""
    return 0.5 * ((w[:, None] * other[None, :] - e) * ds).sum()


@density.derivative
def _of_density(result, arguments, slopes):
    v, of, measured = arguments
    return density_slope(quotient(v, of), quotient(v, of), inverse(of, measured), *slopes[:2])


def density_slope(w, weighted, e, dv, ds):
    """-w' dv + 1/2 tr((w w' - e) dS), where the second w, `weighted`, may be w times a weight."""
    by_cov = through(lambda slope: half_trace(w, weighted, e, slope), ds)
    return minus(by_cov, through(lambda slope: dot(weighted, slope), dv))


# Outliers: Student's t density with the covariance S in place of the normal one


@operation(lambda *shapes: ())
def heavier(q, measured, tail):
    """The difference log t(v) - log N(v; 0, S) for q = v' S^-1 v over d channels; see `tail_of`."""
    inverse, d = tail[0], sum(where(channel, 1.0, 0.0) for channel in measured)
    level = sum(where(d == k, tail[1 + k], 0.0) for k in range(len(measured) + 1))
    safe_inverse = where(inverse > 0.0, inverse, 0.25)
    larger = (
        level
        + 0.5 * q
        - 0.5 * (1.0 / safe_inverse + d) * np.log(1.0 + safe_inverse * q / (1.0 - 2.0 * safe_inverse))
    )
    return where(inverse > 0.0, larger, 0.0)


@operation(lambda *shapes: ())
def outlier_weight(q, measured, tail):
    """(nu + d)/(nu - 2 + q), the factor of the slope of log t to that of log N by v; 1 for the normal density."""
    inverse, d = tail[0], sum(where(channel, 1.0, 0.0) for channel in measured)
    return (1.0 + inverse * d) / (1.0 - 2.0 * inverse + inverse * q)


def tail_of(degrees: float, channels: int) -> list[float]:
    """The argument `tail` for nu degrees of freedom: 1/nu, and the level for each number d of channels.

    All are zero for the normal density, nu = inf.

    log t = log N + q/2 + level - (nu + d)/2 log(1 + q/(nu - 2)),
    level = d/2 log(2/(nu - 2)) + log G((nu + d)/2) - log G(nu/2)
    """
    if degrees == math.inf:
        return [0.0] * (channels + 2)
    half, level = 0.5 * degrees, 0.5 * math.log(2.0 / (degrees - 2.0))
    return [
        1.0 / degrees,
        *(d * level + math.lgamma(half + d / 2) - math.lgamma(half) for d in range(channels + 1)),
    ]
