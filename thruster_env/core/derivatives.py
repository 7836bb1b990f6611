"""Jacobians of functions by complex steps or central differences, and steps of rates with their Jacobians.

The steps are those of Runge and Kutta, and of Euler, of rates written on tuples of components.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache, lru_cache
from types import FunctionType
from typing import Any
from weakref import WeakSet

import numpy as np

from thruster_env.core.angles import NAMES, short_way
from thruster_env.core.equal_functions import makes_functions
from thruster_env.core.sources import Index, Source, is_array, matrix_of, scaled_sum, tuple_of, written_out

RELATIVE_STEP = 6e-6  # cube root of the float64 resolution balances truncation and rounding
MOST_SCALES = 1e9  # from zero: steps are at most 0.6 % of a scale
LEAST_STEP = 2.0**-42  # relative to the number itself, which has 52 bits
COMPLEX_STEP = 1e-100  # no subtraction, hence no cancellation: it may be this small
STEEPEST = 1e30  # slope by a complex step: that of a root at zero is 1e50, for it has none

_EXACT: WeakSet[Callable] = WeakSet()  # what `complex_step` has returned


def step_of(x, scale, far):
    """How far to go from x for a central difference of a function that curves over lengths like `scale`.

        h = (eps r)^(1/3) s

    Rounding, eps r s/h, and truncation, (h/s)^2, are then alike. It is a power of two, so that far from
    zero x + h and x - h are exact.

    Args:
        x: component of a vector.
        scale: s, of the component.
        far: r^(1/3), with the largest magnitude r of all components in their scales; see `step_growth`.
    """
    size = scale if scale > 0.0 else abs(x) if x != 0.0 else 1.0
    h = max(RELATIVE_STEP * size * far, LEAST_STEP * abs(x))
    return math.ldexp(1.0, math.frexp(h)[1] - 1)


@cache
def step_growth(count: int) -> Callable:
    """Return `step_growth(x, scales)`: the cube root of the largest 1 + |x_i|/s_i of `count` components.

    The rounding error of a result grows with its largest component, whichever component is varied.
    """
    source = Source("step_growth", "x, scales", x=(count,), scales=(count,))
    source.line("most = 1.0")
    for i in source.range(count):
        source.line(f"most = max(most, 1.0 + abs(x[{i}]) / max(scales[{i}], 1e-300))")
    return source.function(f"min(most, {MOST_SCALES}) ** (1.0 / 3.0)")


def _sides(name: str, rows: int, call: str, width: str, h: str) -> list[str]:
    """Lines after those that set both sides: of one that has no value, the middle takes its place.

    Args:
        name: of the sides, {name} the word "above" or "below".
        rows: number of components.
        call: the function's value in the middle.
        width: name of the distance between both sides.
        h: of half of it.
    """
    lines = [f"{width} = 2.0 * {h}"]
    for word, side in (("if", "above"), ("elif", "below")):
        value_name = name.format(side)
        finite = f"all_finite({value_name})" if is_array(rows) else _all_finite(value_name, rows)
        value = f"{value_name}[:]" if is_array(rows) else value_name
        lines += [f"{word} not ({finite}):", f"    {value}, {width} = {call}, {h}"]
    return lines


def all_finite(values):
    """Whether all entries of an array are finite."""
    for i in range(len(values)):
        if not math.isfinite(values[i]):
            return False
    return True


def _all_finite(name: str, rows: int) -> str:
    return " and ".join(f"isfinite({name}[{i}])" for i in range(rows))


def _stores(rows: int, entry: Callable) -> list[str]:
    """Lines that set column j of `out`, of `rows` components with the sources entry(i)."""
    if is_array(rows):
        return [f"for i in range({rows}):", f"    out[i, j] = {entry(Index('i'))}"]
    return [f"out[{i}, j] = {entry(i)}" for i in range(rows)]


def slope_by_complex_step(y):
    """Im y / h, or 0 where it is that of a root at zero: the slope of a traced root there (`filters.algebra`)."""
    slope = (0j + y).imag / COMPLEX_STEP
    return 0.0 if abs(slope) > STEEPEST else slope


@makes_functions
def complex_step(function: Callable, rows: int, columns: int, arguments: str) -> Callable:
    """Return `jacobian(x, <arguments>)`: df/dx_j = Im f(x + i h e_j) / h, exact to rounding, 0 for a root at 0.

    Args:
        function: an analytic function of a tuple of `columns` components and the arguments, made of arithmetic and
            numpy functions that take complex numbers. (`abs`, comparisons and `math` are not among them: `abs`
            would silently give a wrong derivative.) An entry with a root at zero is 0 as a whole, also that of
            x - sqrt(x), of which a traced function has the slope 1.
        rows: number of components of its result.
        columns: number of components of x.
        arguments: names of the other arguments, comma separated.

    Source: Squire, Trapp (1998), "Using complex variables to estimate derivatives of real functions", SIAM Review.
    """
    loops = is_array(rows, columns) or is_array(columns)
    if loops:
        lines = _complex_steps_in_loops(rows, columns, arguments)
    else:
        points = (
            tuple_of(f"complex(x[{i}], {COMPLEX_STEP if i == j else 0.0})" for i in range(columns))
            for j in range(columns)
        )
        lines = [f"y{j} = function({point}, {arguments})" for j, point in enumerate(points)]
        lines.append(matrix_of(rows, columns, lambda i, j: f"slope(y{j}[{i}])"))
    names: dict[str, Any] = {"function": function, "slope": slope_by_complex_step, "np": np}
    jacobian_ = written_out("jacobian", f"x, {arguments}", *lines, **names)
    _EXACT.add(jacobian_)
    return jacobian_


def _complex_steps_in_loops(rows: int, columns: int, arguments: str) -> list[str]:
    if is_array(columns):
        point: tuple[str, ...] = "point = x + 0j", f"point[j] = complex(x[j], {COMPLEX_STEP})"
    else:
        step = f"{COMPLEX_STEP} if j == {{0}} else 0.0"
        point = ("point = " + tuple_of(f"complex(x[{i}], {step.format(i)})" for i in range(columns)),)
    stores = _stores(rows, lambda i: f"slope(y[{i}])")
    body = (f"    {line}" for line in (*point, f"y = function(point, {arguments})", *stores))
    return [f"out = np.empty(({rows}, {columns}))", f"for j in range({columns}):", *body, "out"]


def by_complex_step(function: Callable) -> bool:
    """Whether `complex_step` has returned this Jacobian."""
    return isinstance(function, FunctionType) and function in _EXACT  # others need not have a hash


TOOLS: dict[str, Any] = {
    "np": np,
    "isfinite": math.isfinite,
    "all_finite": all_finite,
    "step_of": step_of,
    **NAMES,
}


def _differences_in_loops(
    function: Callable, rows: int, columns: int, arguments: str, angles: tuple[bool, ...]
) -> Callable:
    sides = []
    for name, sign in (("above", "+"), ("below", "-")):
        if is_array(columns):
            sides += ["point = x.copy()", f"point[j] {sign}= h"]
        else:
            shifted = (f"x[{i}] {sign} h if j == {i} else x[{i}]" for i in range(columns))
            sides.append("point = " + tuple_of(shifted))
        sides += [f"{name} = function(point, {arguments})"]
    size = "x[j]" if is_array(columns) else "sizes[j]"
    scale = "scales[j]" if is_array(columns) else "steps[j]"
    copies = [] if is_array(columns) else ["sizes, steps = np.array(x), np.array(scales)"]
    sides += _sides("{}", rows, f"function(x, {arguments})", "width", "h")
    stores = _stores(rows, lambda i: short_way(f"(above[{i}] - below[{i}])", i, angles) + " / width")
    body = f"h = step_of({size}, {scale}, far)", *sides, *stores
    start = (
        "far = step_growth(x, scales)",
        f"out = np.empty(({rows}, {columns}))",
        *copies,
        f"for j in range({columns}):",
    )
    lines = *start, *(f"    {line}" for line in body)
    names: dict[str, Any] = {"function": function, "step_growth": step_growth(columns), **TOOLS}
    return written_out("jacobian", f"x, scales, {arguments}", *lines, "out", **names)


@lru_cache(maxsize=64)
def jacobian(
    function: Callable,
    analytic: Callable | None,
    rows: int,
    columns: int,
    arguments: str,
    angles: tuple[bool, ...] = (),
) -> Callable:
    """Return `jacobian(x, scales, <arguments>)`: d function/dx as a tuple of rows.

    Args:
        function: takes a tuple of `columns` components and the arguments, returns a tuple of `rows`.
        analytic: its Jacobian if known, a function of x and the arguments.
        rows: number of components of the result.
        columns: number of components of x.
        arguments: names of the other arguments, comma separated.
        angles: which components of the result are angles, whose differences are wrapped to (-pi, pi].

    The steps of central differences are `step_of`, of tuples x and scales of `columns` components. Where the
    function has no value on one side, the difference is one-sided.
    """
    signature = f"x, scales, {arguments}"
    if analytic is not None:
        return written_out("jacobian", signature, f"analytic(x, {arguments})", analytic=analytic)
    if is_array(rows, columns) or is_array(columns):
        return _differences_in_loops(function, rows, columns, arguments, angles)
    lines = ["far = step_growth(x, scales)"]
    for j in range(columns):
        lines.append(f"h{j} = step_of(x[{j}], scales[{j}], far)")
        for name, sign in (("above", "+"), ("below", "-")):
            point = tuple_of(f"x[{i}] {sign} h{j}" if i == j else f"x[{i}]" for i in range(columns))
            lines.append(f"{name}{j} = function({point}, {arguments})")
        lines += _sides(f"{{}}{j}", rows, f"function(x, {arguments})", f"width{j}", f"h{j}")

    def slope(i, j):
        return short_way(f"(above{j}[{i}] - below{j}[{i}])", i, angles) + f" / width{j}"

    names: dict[str, Any] = {"function": function, "step_growth": step_growth(columns), **TOOLS}
    return written_out("jacobian", signature, *lines, matrix_of(rows, columns, slope), **names)


@makes_functions
def runge_kutta(rates: Callable, count: int) -> Callable:
    """Return `step(x, u, c)`, one classical fourth-order Runge-Kutta step of length c.substep [s].

    `rates(x, u, c)` takes and returns tuples of `count` components; u is held over the step. The same arguments
    give the same function, so that a model made anew for each candidate needs no compilation.

    Raises:
        ValueError: from the step, if x has another number of components.
    """
    add = scaled_sum(count)
    rule = f"count of runge_kutta(rates, count) must be the number of states, but got {count}"

    def step(x, u, c):
        if len(x) != count:
            raise ValueError(rule)
        h = c.substep
        k1 = rates(x, u, c)
        k2 = rates(add(x, 0.5 * h, k1), u, c)
        k3 = rates(add(x, 0.5 * h, k2), u, c)
        k4 = rates(add(x, h, k3), u, c)
        return add(add(add(add(x, h / 6.0, k1), h / 3.0, k2), h / 3.0, k3), h / 6.0, k4)

    return step


@makes_functions
def euler(rates: Callable, count: int) -> Callable:
    """Return `step(x, u, c)`, one step of Euler's method, x + h rates(x, u, c), of length h = c.substep [s]."""
    add = scaled_sum(count)

    def step(x, u, c):
        return add(x, c.substep, rates(x, u, c))

    return step


@makes_functions
def runge_kutta_jacobian(rates: Callable, rates_tangent: Callable, count: int) -> Callable:
    """Return `jacobian(x, u, c)`, the exact derivative by x of the step that `runge_kutta(rates, count)` makes.

    It is the same step of the variational equation d(dx)/dt = (d rates/dx) dx, once for each unit vector dx.
    Stages and directions are loops, so there is one copy of the rates and one of the tangent, whatever the count.

    Args:
        rates: as `runge_kutta` takes it.
        rates_tangent: `rates_tangent(x, dx, u, c)`, its directional derivative at x along dx.
        count: number of components of x, which is a tuple.
    """
    names = {"parts": (0.0, 0.5, 0.5, 1.0), "weights": (1 / 6, 1 / 3, 1 / 3, 1 / 6), "rates": rates}
    return _by_directions(
        rates_tangent, count, "point = add(x, parts[stage + 1] * h, rates(point, u, c))", **names
    )


@makes_functions
def euler_jacobian(rates_tangent: Callable, count: int) -> Callable:
    """Return `jacobian(x, u, c)`, the derivative by x of `euler`'s step; see `runge_kutta_jacobian`."""
    return _by_directions(rates_tangent, count, "pass", parts=(0.0,), weights=(1.0,))


def _by_directions(rates_tangent: Callable, count: int, next_point: str, **names) -> Callable:
    """The derivative of a step whose stages each start from x by a part of the slopes of the one before."""
    lines = (
        "h = c.substep",
        f"slopes, out = np.zeros(({count}, {count})), np.zeros(({count}, {count}))",
        "point = x",
        f"for stage in range({len(names['parts'])}):",
        "    part, weight = parts[stage] * h, weights[stage] * h",
        f"    for j in range({count}):",
        "        dx = " + tuple_of(f"(1.0 if j == {i} else 0.0) + part * slopes[{i}, j]" for i in range(count)),
        "        d = tangent(point, dx, u, c)",
        *(f"        slopes[{i}, j] = d[{i}]" for i in range(count)),
        *(f"        out[{i}, j] += weight * d[{i}]" for i in range(count)),
        f"    if stage < {len(names['parts']) - 1}:",
        f"        {next_point}",
        f"for j in range({count}):",
        "    out[j, j] += 1.0",
        "out" if is_array(count, count) else matrix_of(count, count, lambda i, j: f"out[{i}, {j}]"),
    )
    names = {"tangent": rates_tangent, "add": scaled_sum(count), "np": np, **names}
    return written_out("jacobian", "x, u, c", *lines, **names)
