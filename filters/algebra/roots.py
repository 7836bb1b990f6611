"""Operations of square-root, UD and information filters: inverses, orthogonal triangles, blocks, and factors.

The UD form has factors U, D of P = U D U' in one matrix with D on its diagonal. Most of these operations have no
derivative, because filters in these forms are differentiated in the covariance form.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from filters.algebra import matrices, operations
from filters.algebra.matrices import Operation, minus, operation, same, through
from filters.algebra.operations import factor, forward, mirrored, pivoted
from thruster_env.core import matrices as matrix_functions
from thruster_env.core.matrices import NEGLIGIBLE
from thruster_env.core.sources import (
    LONGEST_TEXT,
    Source,
    assembled,
    is_array,
    matrix_of,
    part_of,
    written_out,
    zeros_of,
)
from thruster_env.graphs.graphs import where


def inverse_of(s):
    """S^-1 of a covariance S."""
    return inverted(factor(s))


@operation(same, lambda of: True)
def inverted(of):
    """S^-1 = W' W from a factor of S, with W = d^(-1/2) L^-1: symmetric and positive by construction."""
    lower, d = of
    w = forward(np.array(np.eye(len(d)), dtype=d.dtype), lower).T  # L^-1
    return mirrored.compute((w.T * (1.0 / d)) @ w)


@operation(same)
def careful(s):
    """The factor of a positive semidefinite S, with which `operations.quotient` is finite.

    If a pivot is zero but for rounding, d is infinite, so that dividing by it gives zero. For a numerator in the
    range of S that is a solution: the gain of components that are known exactly is zero.
    """
    return pivoted(s, lambda d, variance: d > NEGLIGIBLE * variance, math.inf)


@operation(lambda a: (a[0], a[0]))
def triangle(a):
    """The lower triangular L with L L' = A A'; the diagonal is zero in a row that depends on those above it.

    The modified Gram-Schmidt method orthogonalises the rows of A; L is as accurate as by Householder's method.
    Source: Bjorck (1967), "Solving linear least squares problems by Gram-Schmidt orthogonalization".
    """
    rows, lower = [*np.array(a)], np.full((len(a), len(a)), 0.0, dtype=a.dtype)
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
    """The block with `rows` rows and `columns` columns whose first entry is a[top, left]."""
    return a[top : top + rows, left : left + columns]


@operation(
    lambda a, rows, columns: (len(rows), len(columns)), lambda a, rows, columns: a.symmetric and rows == columns
)
def pick(a, rows, columns):
    """The given rows and columns of a matrix, in the given order."""
    return a[np.ix_(rows, columns)]


@operation(lambda a, *shape: shape)
def zeros(a, *shape):
    """A matrix or vector of zeros in the graph of a."""
    return np.zeros(shape)


zeros.derivative(lambda *_: None)


@operation(lambda lower, v: v)
def forward_quotient(lower, v):
    """L^-1 v of a lower triangular L."""
    y = np.array(v)
    for i in range(len(v)):
        y[i] = (y[i] - sum(lower[i, k] * y[k] for k in range(i))) / lower[i, i]
    return y


@operation(same)
def triangle_quotient(a, lower):
    """A L^-1 of a lower triangular L."""
    quotient = np.array(a, dtype=np.result_type(a, lower))
    for i in reversed(range(len(lower))):
        rest = quotient[:, i] - sum(quotient[:, k] * lower[k, i] for k in range(i + 1, len(lower)))
        quotient[:, i] = rest * (1.0 / lower[i, i])
    return quotient


@operation(same)
def factor_of(lower):
    """The factor of S = L L', equal to `operations.factor` of S."""
    d = np.diag(lower)
    return lower * (1.0 / d)[None, :], d * d


@forward_quotient.derivative
def _of_forward_quotient(result, arguments, slopes):
    (lower, _), (dl, dv) = arguments, slopes
    change = minus(dv, through(lambda slope: slope @ result, dl))
    return through(lambda slope: forward_quotient(lower, slope), change)


# Operations of `blocks` and `scalars` as functions that are made for their sizes, for `calls`.


def by_entries(template: str, **functions: Any) -> Callable:
    """Return `make(result, *arguments)`: a function of a, b, c, entry by entry, by a template such as "{a} + {b}".

    `{0}` stands for the first argument that is no shape.
    """

    def make(result: tuple, *arguments: Any) -> Callable:
        known = [argument for argument in arguments if not isinstance(argument, tuple)]
        shapes = dict(zip("abc", arguments[len(known) :], strict=False))

        def entry(*index) -> str:
            at = "".join(f"[{i}]" for i in index)
            return template.format(*known, **{name: name + at * bool(shape) for name, shape in shapes.items()})

        if not result:
            return written_out("entries", ", ".join(shapes), entry(), **functions)
        source = Source("entries", ", ".join(shapes), result=result, **{k: v for k, v in shapes.items() if v})
        return source.function(source.entries(result, entry), **functions)

    return make


def _trace(result: tuple, a: tuple) -> Callable:
    source = Source("trace", "a", a=a)
    return source.function(source.sum(f"a[{i}][{i}]" for i in source.range(a[0])))


def _count(result: tuple, z: tuple) -> Callable:
    source = Source("count", "z", z=z)
    return source.function(source.sum(f"(1.0 if z[{i}] == z[{i}] else 0.0)" for i in source.range(*z)))


def _stacked(result: tuple, a: tuple, b: tuple) -> Callable:
    at = (0, a[1]) if a[0] == result[0] else (a[0], 0)
    return assembled("stacked", "a, b", result, {"a": (a, 0, 0), "b": (b, *at)})


def _diagonal(result: tuple, v: tuple) -> Callable:
    source = Source("diagonal", "v", result=result, v=v)
    return source.function(source.matrix(v[0], v[0], lambda i, j: source.if_same(i, j, f"v[{i}]", "0.0")))


def _pick(result: tuple, rows: tuple[int, ...], columns: tuple[int, ...], a: tuple) -> Callable:
    if not is_array(*result):
        return written_out(
            "pick", "a", matrix_of(len(rows), len(columns), lambda i, j: f"a[{rows[i]}][{columns[j]}]")
        )
    lines = (
        f"out = np.empty({result})",
        f"for i in range({result[0]}):",
        f"    for j in range({result[1]}):",
        "        out[i, j] = a[rows[i], columns[j]]",
        "out",
    )
    return written_out("pick", "a", *lines, np=np, rows=rows, columns=columns)


def _forward_quotient(result: tuple, lower: tuple, v: tuple) -> Callable:
    return matrix_functions.forward_solver(*v) if len(v) == 1 else matrix_functions.column_solver(*v)


FUNCTIONS: dict[Operation, Callable] = {
    matrices.add: by_entries("{a} + {b}"),
    matrices.subtract: by_entries("{a} - {b}"),
    matrices.entries_product: by_entries("{a} * {b}"),
    matrices.shifted: by_entries("{a} + {0!r}"),
    matrices.reciprocal: by_entries("1.0 / {a}"),
    matrices.power: by_entries("{a} ** {0!r}"),
    matrices.magnitude: by_entries("abs({a})"),
    operations.exceeds: by_entries("{a} > {0!r}"),
    operations.is_number: by_entries("{a} == {a}"),
    operations.choose: by_entries("({b} if {a} else {c})"),
    operations.exponential: by_entries("exp({a})", exp=np.exp),
    operations.logarithm: by_entries("log({a})", log=np.log),
    operations.at_most: by_entries("min({a}, {0!r})"),
    operations.at_least: by_entries("({a} if {a} > {0!r} else {0!r})"),
    operations.below: by_entries("(0.0 if {a} > {0!r} else 1.0)"),
    operations.trace: _trace,
    operations.diagonal: _diagonal,
    operations.count: _count,
    careful: lambda result, s: matrix_functions.careful_factor(*s[:1]),
    inverted: lambda result, of: matrix_functions.factored_inverse(of[0]),
    triangle: lambda result, a: matrix_functions.triangular_root(*a),
    hstack: _stacked,
    vstack: _stacked,
    part: lambda result, top, left, rows, columns, a: part_of(rows, columns, a, top, left),
    pick: _pick,
    zeros: lambda result, *shapes: written_out("zeros", "a", "zero()", zero=zeros_of(*result)),
    forward_quotient: _forward_quotient,
    triangle_quotient: lambda result, a, lower: matrix_functions.triangle_divider(*a),
    factor_of: lambda result, lower: written_out("same", "a", "a"),
}


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


def called_unit_upper(ud):
    """U."""
    out = np.eye(len(ud))
    for i in range(len(ud)):
        for j in range(i + 1, len(ud)):
            out[i, j] = ud[i, j]
    return out


def called_upper_root(ud):
    """U D^(1/2)."""
    out = np.zeros(ud.shape)
    for j in range(len(ud)):
        root = ud[j, j] ** 0.5
        for i in range(j):
            out[i, j] = ud[i, j] * root
        out[j, j] = root
    return out


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


UD_FUNCTIONS: dict[Operation, Callable] = {
    unit_upper: _of_arrays(called_unit_upper),
    upper_root: _of_arrays(called_upper_root),
    factors: _of_arrays(called_weighted_factors, more=", np.zeros((0, 0))"),
    weighted_factors: _of_arrays(called_weighted_factors),
    measured_factors: _of_arrays(measured, "[0]"),
    measured_gain: _of_arrays(measured, "[1]"),
}
