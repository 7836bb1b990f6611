"""Equations of a model at points, the columns of a matrix, and their slopes, of functions that are called."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

from filters.pages.differences import difference_of_values, slope_of
from thruster_env.core.sources import Source, entrywise, tuple_of, written_out
from thruster_env.model.shape import Functions, Shape


@cache
def called_at_points(
    functions: Functions, shape: Shape, which: str, constants_move: bool, points: int
) -> tuple[Callable, Callable]:
    """An equation Y(X, ..., c) of points X (n, points), and its slope dY(X, scales, ..., c, dX), by columns.

        dy = [y(x + h dx, c + h dc) - y(x - h dx, c - h dc)]/2h

    Where parameters move constants the slope takes (X, scales, ..., c, dX, dc, size). Other arguments are those of
    `differences.called_parts`.
    """
    if which == "motion":
        value, rows, angles, others = functions.transition, shape.n, shape.state_angles, "u, c"
    else:
        value, rows, angles, others = functions.observe, shape.m, shape.measurement_angles, "c"
    plain = written_out("plain", f"x, scales, {others}", f"value(x, {others})", value=value)
    slope = slope_of(plain, difference_of_values(rows, angles), shape, others, constants_move)
    behind = ", dc, size" if constants_move else ""
    size = shape.n, points
    return (
        _by_columns(value, f"x, {others}", rows, x=size),
        _by_columns(slope, f"x, scales, {others}, dx{behind}", rows, x=size, dx=size),
    )


def _by_columns(function: Callable, arguments: str, rows: int, **matrices: Any) -> Callable:
    """A function (rows,) of vectors as one (rows, points) of matrices, which it takes column by column."""
    n, points = matrices["x"]
    source = Source("by_columns", arguments, result=(rows, points), **matrices)
    out = source.local("out", rows, points)
    for j in source.range(points):
        columns = {
            name: f"column({source.array_of(name)}, {j})"
            if source.loops
            else tuple_of(f"{name}[{i}][{j}]" for i in range(n))
            for name in matrices
        }
        given = (columns.get(name, name) for name in arguments.split(", "))
        source.line(f"y = function({', '.join(given)})")
        if source.loops:
            source.line(f"store(out, {j}, y)")
        else:
            source.line(f"{tuple_of(out[i, j] for i in range(rows))} = y")
    store = Source("store", "out, j, y", y=(rows,))
    for i in store.range(rows):
        store.line(f"out[{i}, j] = y[{i}]")
    column = entrywise("column", "x, j", (n,), lambda i: f"x[{i}, j]")
    return source.function(source.whole(out), function=function, column=column, store=store.function())
