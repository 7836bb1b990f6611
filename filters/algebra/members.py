"""Operations on members of an ensemble: means, covariances, angles on one branch, spread.

Each of N members has a vector of its own. As NumPy's array the vectors of all members are a matrix (n, N) with a
column per member; vectors that all members share are columns (n, 1).

Tables have columns after the last member. These are computed, too, but enter no mean and no covariance.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from math import prod
from typing import Any

import numpy as np

from filters.algebra import matrices, operations, points
from filters.algebra.matrices import Matrix, Operation, operation, same
from filters.algebra.operations import choose, constant, exceeds
from filters.algebra.points import outer
from thruster_env.core import matrices as arrays
from thruster_env.core.angles import row_aligner, whole_turns
from thruster_env.core.sources import Source, column_reader, column_writer, entrywise, is_array, written_out
from thruster_env.core.streams import exponential
from thruster_env.graphs.graphs import Number, arctan2, over_members, size_of, where

Kinds = tuple[tuple[tuple[int, ...], bool], ...]  # of arguments: the shape, and whether each member has one


def _of_numbers(x) -> bool:
    return x.ndim == 1


def _means(x):
    return np.array(
        [entry.graph.make("/", over_members(entry), size_of(entry)) if entry.member else entry for entry in x]
    )


def _deviations(x):
    return x - (_means(x) if _of_numbers(x) else x.mean(axis=1, keepdims=True))


@operation(same, reduces=True)
def mean(x):
    """The mean (n,) of a vector of the members."""
    return _means(x) if _of_numbers(x) else x.mean(axis=1, keepdims=True)


def covariance(x, y):
    """The sample covariance (n, m) of two vectors of the members, with the divisor N - 1."""
    return scatter(x) if x is y else cross_covariance(x, y)


@operation(lambda x, y: (*x, *y), reduces=True)
def cross_covariance(x, y):
    """The sample covariance of two vectors that differ."""
    d, e = _deviations(x), _deviations(y)
    if not _of_numbers(x):
        return d @ e.T / (x.shape[1] - 1)
    factor = 1.0 / (size_of(x[0]) - 1.0)
    return np.array([[over_members(first * other) * factor for other in e] for first in d])


@operation(lambda x: (*x, *x), lambda x: True, reduces=True)
def scatter(x):
    """The sample covariance (n, n) of one vector."""
    return cross_covariance.compute(x, x)


@operation(same, reduces=True)
def variances(x):
    """The sample variances (n,) of the components of a vector of the members."""
    d = _deviations(x)
    if not _of_numbers(x):
        return d.var(axis=1, ddof=1, keepdims=True)
    factor = 1.0 / (size_of(x[0]) - 1.0)
    return np.array([over_members(deviation * deviation) * factor for deviation in d])


def correlations(x, y):
    """The sample correlations (n, m) of two vectors of the members; 0 for constant components."""
    squares = outer(variances(x), variances(y))
    return covariance(x, y) / choose(exceeds(squares, 0.0), squares, constant(1.0, squares)) ** 0.5


@operation(same)
def centred(e):
    """Independent normals (N/(N - 1))^1/2 (e - mean(e)), whose mean is zero and whose variance is 1."""
    size = size_of(e[0]) if _of_numbers(e) else e.shape[1]
    return _deviations(e) * (size / (size - 1.0)) ** 0.5


def on_branch(x, angles, *weights):
    """Members with their angles (flags) within half a turn of their circular mean, which may be weighted."""
    return on_one_branch(x, tuple(angles), *weights) if any(angles) else x


@operation(same)
def on_one_branch(x, angles, weights=1.0):
    """`on_branch`, if there are angles."""

    def aligned(row):
        middle = arctan2(_total(weights * np.sin(row)), _total(weights * np.cos(row)))
        return row - whole_turns(row - middle)

    return np.array([aligned(row) if angle else row for row, angle in zip(x, angles, strict=True)])


def _total(row):
    return over_members(row) if isinstance(row, Number) else row.sum()


@operation(same)
def stretches(before, after, part):
    """Factors (n,) 1 + part (b - a)/a, of variances b^2 before and a^2 after; 1 if a = 0.

    They restore `part` of the reduction b - a of the standard deviation.
    """

    def factor(b, a):
        positive = a > 0.0
        return where(positive, 1.0 + part * ((b / where(positive, a, 1.0)) ** 0.5 - 1.0), 1.0)

    return np.array([factor(b, a) for b, a in zip(before, after, strict=True)])


# Operations on vectors of members as loops over arrays (n, columns), for `calls`: a column per member.


def function_of(matrix: Matrix) -> tuple[Callable, bool] | None:
    """The function that evaluates an operation on all members, and whether their number is its last argument.

    None if `calls` evaluates the operation in a loop over the members.
    """
    parameters = tuple(a for a in matrix.arguments if not isinstance(a, Matrix))
    kinds = tuple((a.shape, a.member) for a in matrix.of)
    work = _function(matrix.operation, matrix.shape, parameters, kinds) if matrix.operation in _RULES else None
    return None if work is None else (work, matrix.operation in SIZED)


@cache
def _function(operation: Operation, result: tuple, parameters: tuple, kinds: Kinds) -> Callable | None:
    """One function for all equal operations; it converts tuples to arrays, and its result back."""
    work = _RULES[operation](parameters, kinds)
    small = {f"a{k}": shape for k, (shape, member) in enumerate(kinds) if not member and _is_tuple(shape)}
    if work is None or not small and not (operation.reduces and _is_tuple(result)):
        return work
    size = ["size"] * (operation in SIZED)
    arguments = [f"a{k}" for k in range(len(kinds))]
    converted = [f"as_array_{name}({name})" if name in small else name for name in arguments]
    call = f"work({', '.join(converted + size)})"
    names: dict[str, Any] = {f"as_array_{k}": _as_array(shape) for k, shape in small.items()}
    if operation.reduces and _is_tuple(result):
        as_tuple = entrywise("as_tuple", "a", result, lambda *at: f"a[{', '.join(map(str, at))}]")
        call, names = f"as_tuple({call})", names | {"as_tuple": as_tuple}
    return written_out("of_members", ", ".join(arguments + size), call, work=work, **names)


def _is_tuple(shape: tuple[int, ...]) -> bool:
    return bool(shape) and not is_array(*shape)


@cache
def _as_array(shape: tuple[int, ...]) -> Callable:
    lines = [f"out = np.empty({shape})"]
    for index in np.ndindex(*shape):
        lines.append(f"out[{', '.join(map(str, index))}] = a" + "".join(f"[{i}]" for i in index))
    return written_out("as_array", "a", *lines, "out", np=np)


def entry(name: str, shape: tuple[int, ...], member: bool) -> str:
    """Source of number i of a value, in column j if each member has one."""
    if member:
        return f"{name}[{'i' if shape else 0}, j]"
    if len(shape) == 2:
        return f"{name}[i // {shape[1]}][i % {shape[1]}]"
    return f"{name}[i]" if shape else name


@cache
def reader(shape: tuple[int, ...]) -> Callable:
    """A function (array, j) that reads a value from a column."""
    if len(shape) == 2:
        return entrywise("read", "array, j", shape, lambda i, k: f"array[{i * shape[1] + k}, j]")
    return column_reader(*shape) if shape else written_out("read", "array, j", "array[0, j]")


@cache
def writer(shape: tuple[int, ...]) -> Callable:
    """A function (array, j, value) that writes a value into a column."""
    if len(shape) < 2:
        return column_writer(*shape) if shape else written_out("store", "array, j, x", "array[0, j] = x", "None")
    source = Source("store", "array, j, x", x=shape)
    for i in source.range(shape[0]):
        for k in source.range(shape[1]):
            source.line(f"array[{i * shape[1] + k}, j] = x[{i}][{k}]")
    return source.function()


def _by_entries(kinds: Kinds, text: str) -> Callable | None:
    """A function of a0, a1, entry by entry as `text` says; the members' values are arrays (n, columns).

    None if members have matrices, or vectors small enough for registers: then a loop over the members is faster.
    """
    longest = max(range(len(kinds)), key=lambda k: (prod(kinds[k][0]), kinds[k][1]))
    if not is_array(*kinds[longest][0]) or any(member and len(shape) > 1 for shape, member in kinds):
        return None
    entries = {f"a{k}": entry(f"a{k}", *kind) for k, kind in enumerate(kinds)}
    first = next(f"a{k}" for k, (_, member) in enumerate(kinds) if member)
    size = f"a{longest}.shape[0], {first}.shape[1]"
    return _of_entries(", ".join(entries), size, text.format(**entries))


@cache
def _of_entries(arguments: str, size: str, text: str) -> Callable:
    lines = (
        f"out = np.empty(({size}))",
        "for i in range(out.shape[0]):",
        "    for j in range(out.shape[1]):",
        f"        out[i, j] = {text}",
        "out",
    )
    return written_out("by_entries", arguments, *lines, np=np)


def _called_means(a, size):
    out = np.zeros(a.shape[0])
    for i in range(a.shape[0]):
        total = 0.0
        for j in range(size):
            total += a[i, j]
        out[i] = total / size
    return out


def _over_size(out, size):
    for i in range(out.shape[0]):
        for k in range(out.shape[1]):
            out[i, k] /= size - 1
    return out


def _square(a, size):
    return _over_size(
        arrays.square_of_rows(arrays.deviations(a, 0, a.shape[0], _called_means(a, size), size)), size
    )


def _covariance(a, b, size):
    d = arrays.deviations(a, 0, a.shape[0], _called_means(a, size), size)
    return _over_size(
        arrays.product_of_rows(d, arrays.deviations(b, 0, b.shape[0], _called_means(b, size), size)), size
    )


def _variances(a, size):
    means, out = _called_means(a, size), np.zeros(a.shape[0])
    for i in range(a.shape[0]):
        total = 0.0
        for j in range(size):
            total += (a[i, j] - means[i]) ** 2
        out[i] = total / (size - 1)
    return out


def _centred(a, size):
    means, factor, out = _called_means(a, size), (size / (size - 1.0)) ** 0.5, np.empty_like(a)
    for i in range(a.shape[0]):
        for j in range(a.shape[1]):
            out[i, j] = factor * (a[i, j] - means[i])
    return out


def _called_total(a, size):
    total = 0.0
    for j in range(size):
        total += a[0, j]
    return total


def _weighted_sums(a, w, size):
    out = np.zeros(a.shape[0])
    for i in range(a.shape[0]):
        for j in range(size):
            out[i] += w[0, j] * a[i, j]
    return out


def _largest(a, size):
    most = -math.inf
    for j in range(size):
        most = a[0, j] if a[0, j] > most else most
    return most if most > -math.inf else math.nan


def _effective_size(w, size):
    squares = 0.0
    for j in range(size):
        squares += w[0, j] * w[0, j]
    return 1.0 / squares


def _spread_share(w, size):
    rest = minor_total = 0.0
    for j in range(size):
        other = w[0, j] if w[0, j] <= 0.5 else 0.0
        minor_total += other
        rest += other * (1.0 - other)
    return rest + minor_total * (1.0 - minor_total)


def _weighted_square(d, w, size):
    return arrays.weighted_square_of_rows(d[:, :size].copy(), w, 0)


def _on_branch(parameters: tuple, kinds: Kinds) -> Callable:
    n = kinds[0][0][0]
    if len(kinds) == 1:
        return written_out(
            "on_branch", "a, size", "out = a.copy()", "align(out, size)", "out", align=row_aligner(0, *parameters)
        )
    lines = (
        f"out = np.empty(({n} + 1, a.shape[1]))",
        f"out[:{n}], out[{n}] = a, w[0]",
        "align(out, size)",
        f"out[:{n}]",
    )
    return written_out("on_branch", "a, w, size", *lines, np=np, align=row_aligner(0, *parameters, n))


def _product(parameters: tuple, kinds: Kinds) -> Callable | None:
    (matrix, first), (shape, _) = kinds
    return None if first or len(shape) > 1 or not is_array(*matrix) else arrays.sparse_product


def _multiple(parameters: tuple, kinds: Kinds) -> Callable | None:
    return _by_entries(kinds, f"{parameters[0]!r} * {{a0}}" if parameters else "{a1} * {a0}")


_RULES: dict[Operation, Callable[[tuple, Kinds], Callable | None]] = {
    matrices.add: lambda parameters, kinds: _by_entries(kinds, "{a0} + {a1}"),
    matrices.subtract: lambda parameters, kinds: _by_entries(kinds, "{a0} - {a1}"),
    matrices.scale: _multiple,
    matrices.multiply: _product,
    operations.entries_product: lambda parameters, kinds: _by_entries(kinds, "{a0} * {a1}"),
    points.total: lambda parameters, kinds: _called_total,
    points.weighted_mean: lambda parameters, kinds: written_out(
        "mean", "a, w, size", f"sums(a, w, size).reshape({kinds[0][0]})", sums=_weighted_sums
    ),
    points.largest: lambda parameters, kinds: _largest,
    points.effective_size: lambda parameters, kinds: _effective_size,
    points.spread_share: lambda parameters, kinds: _spread_share,
    points.weighted_square: lambda parameters, kinds: _weighted_square,
    mean: lambda parameters, kinds: _called_means,
    variances: lambda parameters, kinds: _variances,
    centred: lambda parameters, kinds: _centred,
    on_one_branch: _on_branch,
    cross_covariance: lambda parameters, kinds: _covariance,
    scatter: lambda parameters, kinds: _square,
}
SIZED = {  # operations whose functions take the number of members
    *(points.total, points.weighted_mean, points.largest, points.effective_size, points.spread_share),
    *(points.weighted_square, mean, variances, cross_covariance, scatter, centred, on_one_branch),
}


def _stretches(result: tuple, before: tuple, after: tuple, part: tuple) -> Callable:
    entry = "(1.0 + p * ((b[{0}] / a[{0}]) ** 0.5 - 1.0) if a[{0}] > 0.0 else 1.0)".format
    source = Source("stretches", "b, a, p", result=result, b=before, a=after)
    return source.function(source.vector(result[0], entry))


FUNCTIONS: dict[Operation, Callable] = {
    stretches: _stretches,
    points.weights: lambda result, logarithm: exponential,
}
