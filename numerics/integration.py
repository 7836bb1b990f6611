"""Runge-Kutta integration of rates written on tuples of components."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from numerics.compiled import inlined
from numerics.pickling import makes_functions
from numerics.sources import is_array, matrix_of, tuple_of, written_out
from numerics.tuples import scaled_sum


def runge_kutta(rates: Callable, count: int) -> Callable:
    """Return `step(x, u, c)`, one classical fourth-order Runge-Kutta step of length c.substep [s].

    `rates(x, u, c)` takes and returns tuples of `count` components; u is held over the step.
    """
    add = scaled_sum(count)

    @inlined
    def step(x, u, c):
        h = c.substep
        k1 = rates(x, u, c)
        k2 = rates(add(x, 0.5 * h, k1), u, c)
        k3 = rates(add(x, 0.5 * h, k2), u, c)
        k4 = rates(add(x, h, k3), u, c)
        return add(add(add(add(x, h / 6.0, k1), h / 3.0, k2), h / 3.0, k3), h / 6.0, k4)

    return step


@makes_functions
def runge_kutta_jacobian(rates: Callable, rates_tangent: Callable, count: int) -> Callable:
    """Return `jacobian(x, u, c)`, the exact derivative by x of the step that `runge_kutta(rates, count)` makes.

    It is the same step of the variational equation d(dx)/dt = (d rates/dx) dx, once for each unit vector dx. That
    is a loop over directions, so there is one copy of the tangent a stage, whatever the count.

    Args:
        rates: as `runge_kutta` takes it.
        rates_tangent: `rates_tangent(x, dx, u, c)`, its directional derivative at x along dx.
        count: number of components of x, which is a tuple.
    """
    stages = (
        ("d1", "x", "direction"),
        ("d2", "x2", "add(direction, 0.5 * h, d1)"),
        ("d3", "x3", "add(direction, 0.5 * h, d2)"),
        ("d4", "x4", "add(direction, h, d3)"),
    )
    slopes = (f"h / 6.0 * (d1[{i}] + 2.0 * d2[{i}] + 2.0 * d3[{i}] + d4[{i}])" for i in range(count))
    whole = matrix_of(count, count, lambda i, j: f"out[{i}, {j}]")
    lines = (
        "h = c.substep",
        "k1 = rates(x, u, c)",
        "x2 = add(x, 0.5 * h, k1)",
        "k2 = rates(x2, u, c)",
        "x3 = add(x, 0.5 * h, k2)",
        "x4 = add(x, h, rates(x3, u, c))",
        f"out = np.empty(({count}, {count}))",
        f"for j in range({count}):",
        "    direction = " + tuple_of(f"1.0 if j == {i} else 0.0" for i in range(count)),
        *(f"    {slope} = tangent({point}, {dx}, u, c)" for slope, point, dx in stages),
        *(f"    out[{i}, j] = direction[{i}] + {slope}" for i, slope in enumerate(slopes)),
        "out" if is_array(count, count) else whole,
    )
    names = {"rates": inlined(rates), "tangent": inlined(rates_tangent), "add": scaled_sum(count), "np": np}
    return written_out("jacobian", "x, u, c", *lines, _loops=True, **names)
