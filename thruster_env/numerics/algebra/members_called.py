"""Operations on vectors of members as loops over arrays (n, columns), for `calls`: a column a member.

Columns behind the last member are worked out, too, but count in no mean and no covariance.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np

from thruster_env.numerics import arrays
from thruster_env.numerics.algebra import matrices, members, operations, scalars
from thruster_env.numerics.algebra.matrices import Matrix, Operation
from thruster_env.numerics.angles import row_aligner
from thruster_env.numerics.compiled import not_inlined
from thruster_env.numerics.sources import Source, entrywise, is_array, written_out
from thruster_env.numerics.tuples import column_reader, column_writer


def function_of(one: Matrix) -> tuple[Callable, bool]:
    """The function that works out an operation on members, and whether their number is its last argument."""
    others = tuple(a for a in one.arguments if not isinstance(a, Matrix))
    kinds = tuple((a.shape, a.member) for a in one.of)
    return _function(one.operation, one.shape, others, kinds), one.operation in SIZED


@cache
def _function(operation: Operation, result: tuple, others: tuple, kinds: tuple) -> Callable:
    """The same for all operations alike. Tuples are turned into arrays, and back."""
    work = _RULES[operation](others, kinds)
    small = {f"a{k}": shape for k, (shape, member) in enumerate(kinds) if not member and _is_tuple(shape)}
    if not small and not (operation.reduces and _is_tuple(result)):
        return work
    size = ["size"] * (operation in SIZED)
    arguments = [f"a{k}" for k in range(len(kinds))]
    given = [f"as_array_{name}({name})" if name in small else name for name in arguments]
    call = f"work({', '.join(given + size)})"
    names: dict[str, Any] = {f"as_array_{k}": _as_array(one) for k, one in small.items()}
    if operation.reduces and _is_tuple(result):
        entry = entrywise("as_tuple", "a", result, lambda *at: f"a[{', '.join(map(str, at))}]")
        call, names = f"as_tuple({call})", names | {"as_tuple": entry}
    return written_out("of_members", ", ".join(arguments + size), call, work=work, **names)


def _is_tuple(shape: tuple[int, ...]) -> bool:
    return bool(shape) and not is_array(*shape)


@cache
def _as_array(shape: tuple[int, ...]) -> Callable:
    lines = [f"out = np.empty({shape})"]
    for place in np.ndindex(*shape):
        lines.append(f"out[{', '.join(map(str, place))}] = a" + "".join(f"[{i}]" for i in place))
    return written_out("as_array", "a", *lines, "out", np=np)


def each(function: Callable, n: int, rows: int, others: int) -> Callable:
    """A function of a vector (n,) and others that returns one of `rows`, as one of members (n, columns)."""
    arguments = ", ".join(["x", *(f"a{k}" for k in range(others))])
    lines = (
        f"out = np.empty(({rows}, x.shape[1]))",
        "for j in range(x.shape[1]):",
        f"    store(out, j, function(read(x, j){arguments[1:]}))",
        "out",
    )
    names: dict[str, Any] = {"function": function, "read": column_reader(n), "store": column_writer(rows)}
    return written_out("each", arguments, *lines, np=np, **names)


@cache
def _by_entries(arguments: str, entry: str) -> Callable:
    """A function of members a (n, columns) and others that returns members, whose entries have a source."""
    loops = "for i in range(a.shape[0]):", "    for j in range(a.shape[1]):"
    lines = "out = np.empty_like(a)", *loops, f"        out[i, j] = {entry}", "out"
    return not_inlined(written_out("by_entries", arguments, *lines, _loops=True, np=np))


@not_inlined
def _means(a, size):
    out = np.zeros(a.shape[0])
    for i in range(a.shape[0]):
        total = 0.0
        for j in range(size):
            total += a[i, j]
        out[i] = total / size
    return out


@not_inlined
def _square(a, size):
    out = arrays.square_of_rows(arrays.deviations(a, 0, a.shape[0], _means(a, size), size))
    for i in range(out.shape[0]):
        for k in range(out.shape[1]):
            out[i, k] /= size - 1
    return out


@not_inlined
def _covariance(a, b, size):
    d = arrays.deviations(a, 0, a.shape[0], _means(a, size), size)
    out = arrays.product_of_rows(d, arrays.deviations(b, 0, b.shape[0], _means(b, size), size))
    for i in range(out.shape[0]):
        for k in range(out.shape[1]):
            out[i, k] /= size - 1
    return out


@not_inlined
def _variances(a, size):
    means, out = _means(a, size), np.zeros(a.shape[0])
    for i in range(a.shape[0]):
        total = 0.0
        for j in range(size):
            total += (a[i, j] - means[i]) ** 2
        out[i] = total / (size - 1)
    return out


@not_inlined
def _centred(a, size):
    means, factor, out = _means(a, size), (size / (size - 1.0)) ** 0.5, np.empty_like(a)
    for i in range(a.shape[0]):
        for j in range(a.shape[1]):
            out[i, j] = factor * (a[i, j] - means[i])
    return out


def _of_two(sign: str) -> Callable:
    """What is done with the entries of two vectors, of which each member has one or both."""

    def make(others: tuple, kinds: tuple) -> Callable:
        (_, first), (_, second) = kinds
        if not first:
            return _by_entries("v, a", f"v[i] {sign} a[i, j]")
        return _by_entries("a, b", f"a[i, j] {sign} {'b[i, j]' if second else 'b[i]'}")

    return make


def _multiple(others: tuple, kinds: tuple) -> Callable:
    return _by_entries("a", f"{others[0]!r} * a[i, j]") if others else _by_entries("a, f", "f * a[i, j]")


def _on_branch(others: tuple, kinds: tuple) -> Callable:
    lines = "out = a.copy()", "align(out, size)", "out"
    return written_out("on_branch", "a, size", *lines, align=row_aligner(0, others[0]))


_RULES: dict[Operation, Callable] = {
    matrices.add: _of_two("+"),
    matrices.subtract: _of_two("-"),
    matrices.scale: _multiple,
    matrices.multiply: lambda others, kinds: arrays.sparse_product,
    operations.only: lambda others, kinds: _by_entries("z, a", "a[i, j] if z[i] == z[i] else 0.0"),
    scalars.entries_product: _of_two("*"),
    members.mean: lambda others, kinds: _means,
    members.variances: lambda others, kinds: _variances,
    members.centred: lambda others, kinds: _centred,
    members.on_one_branch: _on_branch,
    members.cross_covariance: lambda others, kinds: _covariance,
    members.scatter: lambda others, kinds: _square,
}
SIZED = {  # operations that ask how many members there are
    *(members.mean, members.variances, members.cross_covariance, members.scatter),
    *(members.centred, members.on_one_branch),
}


def _stretches(result: tuple, before: tuple, after: tuple, part: tuple) -> Callable:
    entry = "(1.0 + p * ((b[{0}] / a[{0}]) ** 0.5 - 1.0) if a[{0}] > 0.0 else 1.0)".format
    source = Source("stretches", "b, a, p", result=result, b=before, a=after)
    return source.function(source.vector(result[0], entry))


FUNCTIONS: dict[Operation, Callable] = {members.stretches: _stretches}
