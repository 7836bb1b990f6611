"""Operations of `blocks` and `scalars` as functions that are made for their sizes, for `calls`."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from thruster_env.numerics import matrices as made
from thruster_env.numerics.algebra import blocks, scalars
from thruster_env.numerics.algebra.matrices import Operation
from thruster_env.numerics.sources import Source, entrywise, is_array, matrix_of, written_out
from thruster_env.numerics.tuples import assembled, part_of, zeros_of


def _number(text: str, names: str = "a, b") -> Callable:
    return written_out("number", names, text)


def _chosen(result: tuple, condition: tuple, a: tuple, b: tuple) -> Callable:
    if not a:
        return _number("(a if c else b)", "c, a, b")
    at = "[{}]" * len(a)
    entry = f"(a{at} if c else b{at})"
    return entrywise("chosen", "c, a, b", a, lambda *place: entry.format(*place, *place), a=a, b=b)


def _trace(result: tuple, a: tuple) -> Callable:
    source = Source("trace", "a", a=a)
    return source.function(source.sum(f"a[{i}][{i}]" for i in source.range(a[0])))


def _count(result: tuple, z: tuple) -> Callable:
    source = Source("count", "z", z=z)
    return source.function(source.sum(f"(1.0 if z[{i}] == z[{i}] else 0.0)" for i in source.range(*z)))


def _together(result: tuple, a: tuple, b: tuple) -> Callable:
    at = (0, a[1]) if a[0] == result[0] else (a[0], 0)
    return assembled("together", "a, b", result, {"a": (a, 0, 0), "b": (b, *at)})


def _exponential(result: tuple, v: tuple) -> Callable:
    if not v:
        return written_out("exponential", "v", "exp(v)", exp=np.exp)
    source = Source("exponential", "v", result=result, v=v)
    return source.function(source.vector(v[0], lambda i: f"exp(v[{i}])"), exp=np.exp)


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


FUNCTIONS: dict[Operation, Callable] = {
    scalars.reciprocal: lambda result, a: _number("1.0 / a", "a"),
    scalars.power: lambda result, exponent, a: _number(f"a ** {exponent!r}", "a"),
    scalars.exceeds: lambda result, value, a: _number(f"a > {value!r}", "a"),
    scalars.is_number: lambda result, a: _number("a == a", "a"),
    scalars.choose: _chosen,
    scalars.trace: _trace,
    scalars.exponential: _exponential,
    scalars.logarithm: lambda result, a: written_out("logarithm", "a", "log(a)", log=np.log),
    scalars.entries_product: lambda result, a, b: entrywise(
        "product", "a, b", a, lambda *at: "a[{0}] * b[{0}]".format("][".join(map(str, at))), a=a, b=b
    ),
    scalars.at_most: lambda result, value, v: entrywise("most", "v", v, lambda i: f"min(v[{i}], {value!r})", v=v),
    scalars.below: lambda result, value, v: entrywise(
        "below", "v", v, lambda i: f"(0.0 if v[{i}] > {value!r} else 1.0)", v=v
    ),
    scalars.diagonal: _diagonal,
    scalars.count: _count,
    scalars.shifted: lambda result, value, a: _number(f"a + {value!r}", "a"),
    blocks.careful: lambda result, s: made.careful_factor(*s[:1]),
    blocks.inverted: lambda result, of: made.factored_inverse(of[0]),
    blocks.triangle: lambda result, a: made.triangular_root(*a),
    blocks.hstack: _together,
    blocks.vstack: _together,
    blocks.part: lambda result, top, left, rows, columns, a: part_of(rows, columns, a, top, left),
    blocks.pick: _pick,
    blocks.zeros: lambda result, *others: written_out("zeros", "a", "zero()", zero=zeros_of(*result)),
    blocks.forward_quotient: lambda result, lower, v: made.forward_solver(*v),
    blocks.triangle_quotient: lambda result, a, lower: made.triangle_divider(*a),
    blocks.factor_of: lambda result, lower: written_out("same", "a", "a"),
}
