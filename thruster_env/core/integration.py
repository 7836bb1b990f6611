"""Runge-Kutta integration of rates written on tuples of components."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from thruster_env.core.compiled import inlined
from thruster_env.core.equal_functions import makes_functions
from thruster_env.core.sources import is_array, matrix_of, scaled_sum, tuple_of, written_out


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

    @inlined
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

    @inlined
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
    names = {"parts": (0.0, 0.5, 0.5, 1.0), "weights": (1 / 6, 1 / 3, 1 / 3, 1 / 6), "rates": inlined(rates)}
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
    names = {"tangent": inlined(rates_tangent), "add": scaled_sum(count), "np": np, **names}
    return written_out("jacobian", "x, u, c", *lines, _loops=True, **names)
