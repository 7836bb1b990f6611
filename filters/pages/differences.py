"""How equations of a model change along a parameter, of functions that are called: by central differences.

What a model says of Jacobians is used as it is; their own slopes, and those along its constants, are differences.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np

from thruster_env.core.angles import NAMES, short_way
from thruster_env.core.derivatives import RELATIVE_STEP, step_of, stretch
from thruster_env.core.sources import Source, entrywise, is_array, tuple_of, written_out
from thruster_env.core.tuples import scaled_sum, vector_reader
from thruster_env.model.shape import Functions, Shape, constants_are_array, observation_slopes, transition_slopes


@cache
def called_parts(functions: Functions, shape: Shape, which: str, constants_move: bool) -> tuple[Callable, ...]:
    """An equation y(x, ..., c), its Jacobian Y(x, scales, ..., c), and the slopes of both.

        y_c dc = [y(c + h dc) - y(c - h dc)]/2h
        dY = [Y(x + h dx, c + h dc) - Y(x - h dx, c - h dc)]/2h

    the first a function of (x, scales, ..., c, dc, size), with the relative size of dc, the second one of (x,
    scales, ..., c, dx, dc, size), or without the last two where constants do not move. Far from zero steps grow
    with `stretch`, as a value is rounded there whatever moves. Large Jacobians of such are differentiated by each
    component of x, of which there are fewer than directions: then a derivative (columns, rows, columns) and its
    contraction with dx follow.

    Args:
        functions: of the model.
        shape: its sizes.
        which: "motion" for f, or "sight" for h.
        constants_move: whether parameters move its constants.
    """
    if which == "motion":
        value, matrix = functions.transition, transition_slopes(functions, shape)
        rows, angles, others = shape.n, shape.state_angles, "u, c"
    else:
        value, matrix = functions.observe, observation_slopes(functions, shape)
        rows, angles, others = shape.m, shape.measurement_angles, "c"
    by_constants = _by_constants(value, rows, shape, angles, others)
    size = rows, shape.n
    entry = "(a[{0}][{1}] - b[{0}][{1}]) / (2.0 * h)"
    difference = entrywise("difference", "a, b, h", size, lambda i, j: entry.format(i, j), a=size, b=size)
    parts = value, matrix, by_constants, slope_of(matrix, difference, shape, others, constants_move)
    large = is_array(rows, shape.n) and which == "motion" and not constants_move
    return (*parts, _curvature(matrix, rows, shape.n, others), _contraction(rows, shape.n)) if large else parts


def _by_constants(value: Callable, rows: int, shape: Shape, angles: tuple[bool, ...], others: str) -> Callable:
    sides = [others.replace("c", f"shift(c, {sign}h, dc)") for sign in ("", "-")]
    lines = (
        f"h = {RELATIVE_STEP} * stretch(x, scales) / max(size, 1e-300)",
        f"above, below = {', '.join(f'value(x, {side})' for side in sides)}",
        "difference(above, below, h)",
    )
    names: dict[str, Any] = {
        "value": value,
        "shift": _constants_shift(shape),
        "difference": difference_of_values(rows, angles),
        "stretch": stretch(shape.n),
    }
    return written_out("by_constants", f"x, scales, {others}, dc, size", *lines, **names)


def difference_of_values(rows: int, angles: tuple[bool, ...]) -> Callable:
    """`difference(above, below, h)`: the slope between two vectors that lie 2 h apart, of angles the short way."""
    source = Source("difference", "above, below, h", result=(rows,), above=(rows,), below=(rows,))
    entries = source.vector(rows, lambda i: short_way(f"(above[{i}] - below[{i}])", i, angles) + " / (2.0 * h)")
    return source.function(entries, **NAMES)


def slope_of(
    function: Callable, difference: Callable, shape: Shape, others: str, constants_move: bool
) -> Callable:
    """`slope(x, scales, ..., c, dx)` of a function (x, scales, ..., c); with dc and its size if constants move."""
    sides = [
        (sign, others.replace("c", f"shift(c, {sign}h, dc)") if constants_move else others) for sign in ("", "-")
    ]
    calls = (f"function(move(x, {sign}h, dx), scales, {side})" for sign, side in sides)
    lines = (
        f"h = step(x, scales, dx, {'size' if constants_move else '0.0'})",
        f"above, below = {', '.join(calls)}",
        "difference(above, below, h)",
    )
    names: dict[str, Any] = {
        "function": function,
        "step": _step(shape.n),
        "move": scaled_sum(shape.n),
        "shift": _constants_shift(shape),
        "difference": difference,
    }
    return written_out("slope", f"x, scales, {others}, dx" + ", dc, size" * constants_move, *lines, **names)


@cache
def _step(count: int) -> Callable:
    """Return `step(x, scales, d, size)`: how far to go along d, and along constants of a relative size."""
    source = Source("step", "x, scales, d, size", x=(count,), scales=(count,), d=(count,))
    source.line("far = stretch(x, scales)")
    source.line("h = max(1e-300, size / far)")
    for i in source.range(count):
        source.line(f"h = max(h, {RELATIVE_STEP} * abs(d[{i}]) / step_of(x[{i}], scales[{i}], far))")
    return source.function(f"{RELATIVE_STEP} / h", step_of=step_of, stretch=stretch(count))


@cache
def _constants_shift(shape: Shape) -> Callable:
    """Return `shift(c, h, dc)`: the constants c + h dc, as the model's functions take them."""
    if constants_are_array(shape.form):
        return written_out("shift", "c, h, dc", "c + h * dc")
    values = [f"c[{i}] + h * dc[{i}]" for i in range(shape.constants)]
    if isinstance(shape.form, int):
        return written_out("shift", "c, h, dc", tuple_of(values))
    return written_out("shift", "c, h, dc", f"Constants({', '.join(values)})", Constants=shape.form)


def _curvature(matrix: Callable, rows: int, columns: int, others: str) -> Callable:
    """`curved(x, scales, ..., c)`: a Jacobian's derivative by each component of x, (columns, rows, columns)."""
    lines = (
        f"out, unit = np.empty(({columns}, {rows}, {columns})), np.zeros({columns})",
        "far = stretch(x, scales)",
        f"for k in range({columns}):",
        "    unit[k] = 1.0",
        "    h = step_of(x[k], scales[k], far)",
        "    d = read(unit)",
        f"    above = matrix(move(x, h, d), scales, {others})",
        f"    below = matrix(move(x, -h, d), scales, {others})",
        f"    for i in range({rows}):",
        f"        for j in range({columns}):",
        "            out[k, i, j] = (above[i, j] - below[i, j]) / (2.0 * h)",
        "    unit[k] = 0.0",
        "out",
    )
    names: dict[str, Any] = {"matrix": matrix, "move": scaled_sum(columns), "read": vector_reader(columns)}
    names |= {"np": np, "step_of": step_of, "stretch": stretch(columns)}
    return written_out("curved", f"x, scales, {others}", *lines, _loops=True, **names)


def _contraction(rows: int, columns: int) -> Callable:
    """`slope(curvature, dx)`: a Jacobian's derivative along dx, from that by each component of x."""
    lines = (
        f"out = np.zeros(({rows}, {columns}))",
        f"for k in range({columns}):",
        f"    for i in range({rows}):",
        f"        for j in range({columns}):",
        "            out[i, j] += dx[k] * curvature[k, i, j]",
        "out",
    )
    return written_out("slope", "curvature, dx", *lines, _loops=True, np=np)
