"""How a model's equations change along a parameter: what the sensitivity recursion of a filter is made of.

A parameter moves a filter's mean by dx and the model's constants by dc.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import NamedTuple

from numerics.angles import NAMES, short_way
from numerics.compiled import inlined
from numerics.derivatives import RELATIVE_STEP
from numerics.formulas import formula
from numerics.sources import Source, entrywise, tuple_of, written_out
from numerics.tuples import scaled_sum, vector_reader
from plants.shape import Functions, Shape, constants_are_array, observation_slopes, transition_slopes


class Parts(NamedTuple):
    """Functions that a recursion calls for each parameter; dc are its slopes of constants, of relative `size`."""

    read_constants: Callable  # (row): dc
    motion: Callable  # (F, dx, x, u, c, dc, size): slope of f(x, u, c), F dx + df/dc dc
    motion_matrix: Callable  # (x, scales, u, c, dx, dc, size): slope of F
    observation: Callable  # (H, dx, x, c, dc, size, z): slope of h(x, c), in channels that are not NaN in z
    observation_matrix: Callable  # (x, scales, c, dx, dc, size): slope of H


@cache
def parts_of(functions: Functions, shape: Shape) -> Parts:
    """Parts by central differences of the model along a parameter.

    df = F dx + [f(x, u, c + h dc) - f(x, u, c - h dc)]/2h, and dF the like of F(x + h dx, u, c + h dc). One
    that moves no constants has what it has in `filters.likelihood`.
    """
    n, m = shape.n, shape.m
    f, h, f_matrix, h_matrix = (
        inlined(functions.transition),
        inlined(functions.observe),
        transition_slopes(functions, shape),
        observation_slopes(functions, shape),
    )
    shift, add, step = _constants_shift(shape), scaled_sum(n), _step(n)
    move, see = _moved(n, n, shape.state_angles), _moved(m, n, shape.measurement_angles)
    motion_difference, observation_difference = _difference(n, n), _difference(m, n)
    present = entrywise("present", "y, z", (m,), lambda i: f"y[{i}] if z[{i}] == z[{i}] else 0.0", y=(m,), z=(m,))

    @inlined
    def motion(slopes, dx, x, u, c, dc, size):
        e = RELATIVE_STEP / max(size, 1e-300)
        return move(slopes, dx, f(x, u, shift(c, e, dc)), f(x, u, shift(c, -e, dc)), e)

    @inlined
    def observation(slopes, dx, x, c, dc, size, z):
        e = RELATIVE_STEP / max(size, 1e-300)
        return present(see(slopes, dx, h(x, shift(c, e, dc)), h(x, shift(c, -e, dc)), e), z)

    @inlined
    def motion_matrix(x, scales, u, c, dx, dc, size):
        e = step(x, scales, dx, size)
        above = f_matrix(add(x, e, dx), scales, u, shift(c, e, dc))
        return motion_difference(above, f_matrix(add(x, -e, dx), scales, u, shift(c, -e, dc)), e)

    @inlined
    def observation_matrix(x, scales, c, dx, dc, size):
        e = step(x, scales, dx, size)
        above = h_matrix(add(x, e, dx), scales, shift(c, e, dc))
        return observation_difference(above, h_matrix(add(x, -e, dx), scales, shift(c, -e, dc)), e)

    read = vector_reader(shape.constants)
    return Parts(read, motion, motion_matrix, observation, observation_matrix)


@cache
def _constants_shift(shape: Shape) -> Callable:
    """Return `shift(c, h, dc)`: the constants c + h dc, as the model's functions take them."""
    if constants_are_array(shape.form):
        return written_out("shift", "c, h, dc", "c + h * dc")
    values = [f"c[{i}] + h * dc[{i}]" for i in range(shape.constants)]
    if isinstance(shape.form, int):
        return written_out("shift", "c, h, dc", tuple_of(values))
    return written_out("shift", "c, h, dc", f"Constants({', '.join(values)})", Constants=shape.form)


@cache
def _step(count: int) -> Callable:
    """Return `step(x, scales, d, size)`: how far to go along d, and along constants of a relative size."""
    source = Source("step", "x, scales, d, size", x=(count,), scales=(count,), d=(count,))
    source.line("h = max(1e-300, size)")
    for i in source.range(count):
        source.line(f"h = max(h, abs(d[{i}]) / (abs(x[{i}]) + scales[{i}]))")
    return source.function(f"{RELATIVE_STEP} / h")


@cache
def _moved(rows: int, columns: int, angles: tuple[bool, ...]) -> Callable:
    """Return `move(a, dx, above, below, h)`: a dx + (above - below)/2h, angles the short way round."""
    product, row = formula("A dx", A=(rows, columns), dx=(columns,)), (rows,)
    source = Source("total", "y, above, below, h", result=row, y=row, above=row, below=row)
    entries = source.vector(
        rows, lambda i: f"y[{i}] + " + short_way(f"(above[{i}] - below[{i}])", i, angles) + " / (2.0 * h)"
    )
    total = source.function(entries, **NAMES)

    @inlined
    def move(a, dx, above, below, h):
        return total(product(a, dx), above, below, h)

    return move


@cache
def _difference(rows: int, columns: int) -> Callable:
    """Return `difference(a, b, h)`: the matrix (a - b)/2h."""
    shape = rows, columns
    return entrywise(
        "difference", "a, b, h", shape, lambda i, j: f"(a[{i}][{j}] - b[{i}][{j}]) / (2.0 * h)", a=shape, b=shape
    )
