"""Operations of `points` as functions that are made for their sizes, for `calls`."""

from __future__ import annotations

import math
from collections.abc import Callable

from filters.algebra import points
from filters.algebra.matrices import Operation
from thruster_env.core import matrices as made
from thruster_env.core.angles import row_brancher
from thruster_env.core.sources import Source, entrywise, written_out


def _root_slope(result: tuple, *of: tuple) -> Callable:
    n = result[0]
    source = Source("root_slope", "l, dp", result=result, l=result, dp=result, work=n**3 // 3)
    slope = source.local("s", n, n)
    for j in source.range(n):
        known = source.sum(f"l[{j}][{k}] * {slope[j, k]}" for k in source.range(j))
        source.line(f"d = dp[{j}][{j}] - 2.0 * ({known})")
        source.line(f"r = 1.0 / l[{j}][{j}] if l[{j}][{j}] != 0.0 else 0.0")
        lost = f"(nan if abs(d) > {points.UNKNOWN} * abs(dp[{j}][{j}]) else 0.0)"
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


def _outer(result: tuple, a: tuple, b: tuple) -> Callable:
    return entrywise("outer", "a, b", result, lambda i, j: f"a[{i}] * b[{j}]", a=a, b=b)


def _columns(result: tuple, a: tuple) -> Callable:
    return entrywise("others", "a", result, lambda i, j: f"a[{i}][{j + 1}]", a=a)


def _on_one_side(result: tuple, angles: tuple[bool, ...], of: tuple) -> Callable:
    turn, back, align = made.transposer(*of), made.transposer(*of[::-1]), row_brancher(of[1], angles)
    return written_out("on_one_side", "y", "back(align(turn(y)))", turn=turn, back=back, align=align)


def _hats(result: tuple, u: tuple, nodes: tuple) -> Callable:
    source = Source("hats", "u, x", result=result, x=nodes)
    found = source.local("w", *result)
    for s in range(*result):
        sides = [f"(u[0] - x[{s - 1}]) / (x[{s}] - x[{s - 1}])"] * (s > 0)
        sides += [f"(x[{s + 1}] - u[0]) / (x[{s + 1}] - x[{s}])"] * (s < result[0] - 1)
        source.line(f"{found[s]} = max(0.0, min(1.0, {', '.join(sides)}))")
    return source.function(source.whole(found))


FUNCTIONS: dict[Operation, Callable] = {
    points.root: lambda result, of: made.semidefinite_factor(*result[:1]),
    points.root_slope: _root_slope,
    points.units: _units,
    points.ones: lambda result, of: entrywise("ones", "a", result, lambda i: "1.0"),
    points.outer: _outer,
    points.square: lambda result, of: made.square(*of),
    points.first: lambda result, of: entrywise("first", "a", result, lambda i: f"a[{i}][0]", a=of),
    points.others: _columns,
    points.on_one_side: _on_one_side,
    points.hats: _hats,
}
