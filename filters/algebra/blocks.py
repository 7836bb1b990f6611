"""What pages of square-root and information filters say: inverses, orthogonal triangles, and blocks of matrices.

Filters in these forms are differentiated in the covariance form, so that most of them have no derivative.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from filters.algebra import matrices, scalars
from filters.algebra.matrices import Operation, minus, operation, same, through
from filters.algebra.operations import factor, forward, mirrored, pivoted
from thruster_env.core import matrices as made
from thruster_env.core.matrices import NEGLIGIBLE
from thruster_env.core.sources import Source, assembled, is_array, matrix_of, part_of, written_out, zeros_of
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


# Operations of `blocks` and `scalars` as functions that are made for their sizes, for `calls`.


def by_entries(template: str, **functions: Any) -> Callable:
    """What makes functions of a, b, c whose entries have a source, such as "{a} + {b}" or "{a} > {0}"."""

    def make(result: tuple, *others: Any) -> Callable:
        known = [one for one in others if not isinstance(one, tuple)]
        shapes = dict(zip("abc", others[len(known) :], strict=False))

        def entry(*place) -> str:
            at = "".join(f"[{i}]" for i in place)
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


def _together(result: tuple, a: tuple, b: tuple) -> Callable:
    at = (0, a[1]) if a[0] == result[0] else (a[0], 0)
    return assembled("together", "a, b", result, {"a": (a, 0, 0), "b": (b, *at)})


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
    return written_out("pick", "a", *lines, _loops=True, np=np, rows=rows, columns=columns)


def _forward_quotient(result: tuple, lower: tuple, v: tuple) -> Callable:
    return made.forward_solver(*v) if len(v) == 1 else made.column_solver(*v)


FUNCTIONS: dict[Operation, Callable] = {
    matrices.add: by_entries("{a} + {b}"),
    matrices.subtract: by_entries("{a} - {b}"),
    matrices.entries_product: by_entries("{a} * {b}"),
    matrices.shifted: by_entries("{a} + {0!r}"),
    matrices.reciprocal: by_entries("1.0 / {a}"),
    matrices.power: by_entries("{a} ** {0!r}"),
    matrices.magnitude: by_entries("abs({a})"),
    scalars.exceeds: by_entries("{a} > {0!r}"),
    scalars.is_number: by_entries("{a} == {a}"),
    scalars.choose: by_entries("({b} if {a} else {c})"),
    scalars.exponential: by_entries("exp({a})", exp=np.exp),
    scalars.logarithm: by_entries("log({a})", log=np.log),
    scalars.at_most: by_entries("min({a}, {0!r})"),
    scalars.at_least: by_entries("({a} if {a} > {0!r} else {0!r})"),
    scalars.below: by_entries("(0.0 if {a} > {0!r} else 1.0)"),
    scalars.trace: _trace,
    scalars.diagonal: _diagonal,
    scalars.count: _count,
    careful: lambda result, s: made.careful_factor(*s[:1]),
    inverted: lambda result, of: made.factored_inverse(of[0]),
    triangle: lambda result, a: made.triangular_root(*a),
    hstack: _together,
    vstack: _together,
    part: lambda result, top, left, rows, columns, a: part_of(rows, columns, a, top, left),
    pick: _pick,
    zeros: lambda result, *others: written_out("zeros", "a", "zero()", zero=zeros_of(*result)),
    forward_quotient: _forward_quotient,
    triangle_quotient: lambda result, a, lower: made.triangle_divider(*a),
    factor_of: lambda result, lower: written_out("same", "a", "a"),
}
