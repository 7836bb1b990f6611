"""Operations of `blocks` and `scalars` as functions that are made for their sizes, for `calls`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from filters.algebra import blocks, matrices, scalars
from filters.algebra.matrices import Operation
from thruster_env.core import matrices as made
from thruster_env.core.sources import Source, is_array, matrix_of, written_out
from thruster_env.core.tuples import assembled, part_of, zeros_of


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
    blocks.careful: lambda result, s: made.careful_factor(*s[:1]),
    blocks.inverted: lambda result, of: made.factored_inverse(of[0]),
    blocks.triangle: lambda result, a: made.triangular_root(*a),
    blocks.hstack: _together,
    blocks.vstack: _together,
    blocks.part: lambda result, top, left, rows, columns, a: part_of(rows, columns, a, top, left),
    blocks.pick: _pick,
    blocks.zeros: lambda result, *others: written_out("zeros", "a", "zero()", zero=zeros_of(*result)),
    blocks.forward_quotient: _forward_quotient,
    blocks.triangle_quotient: lambda result, a, lower: made.triangle_divider(*a),
    blocks.factor_of: lambda result, lower: written_out("same", "a", "a"),
}
