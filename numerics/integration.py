"""Runge-Kutta integration of rates written on tuples of components."""

from __future__ import annotations

from collections.abc import Callable, Iterable

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

    It is the same step of the variational equation d(dx)/dt = (d rates/dx) dx, once for each unit vector dx. That
    is a loop over directions, so there is one copy of the tangent a stage, whatever the count.

    Args:
        rates: as `runge_kutta` takes it.
        rates_tangent: `rates_tangent(x, dx, u, c)`, its directional derivative at x along dx.
        count: number of components of x, which is a tuple.
    """
    points = (
        "k1 = rates(x, u, c)",
        "x2 = add(x, 0.5 * h, k1)",
        "k2 = rates(x2, u, c)",
        "x3 = add(x, 0.5 * h, k2)",
        "x4 = add(x, h, rates(x3, u, c))",
    )
    stages = (
        "d1 = tangent(x, dx, u, c)",
        "d2 = tangent(x2, add(dx, 0.5 * h, d1), u, c)",
        "d3 = tangent(x3, add(dx, 0.5 * h, d2), u, c)",
        "d4 = tangent(x4, add(dx, h, d3), u, c)",
    )
    mean = "(d1[{0}] + 2.0 * d2[{0}] + 2.0 * d3[{0}] + d4[{0}]) / 6.0"
    names = {"rates": inlined(rates), "tangent": inlined(rates_tangent)}
    return _by_directions(points, stages, mean, count, **names)


@makes_functions
def euler_jacobian(rates_tangent: Callable, count: int) -> Callable:
    """Return `jacobian(x, u, c)`, the derivative by x of `euler`'s step; see `runge_kutta_jacobian`."""
    return _by_directions((), ("d = tangent(x, dx, u, c)",), "d[{0}]", count, tangent=inlined(rates_tangent))


def _by_directions(points: Iterable[str], stages: Iterable[str], slope: str, count: int, **names) -> Callable:
    """A Jacobian by columns: lines that come first, those for each direction dx, the mean slope of row {0}."""
    lines = (
        "h = c.substep",
        *points,
        f"out = np.empty(({count}, {count}))",
        f"for j in range({count}):",
        "    dx = " + tuple_of(f"1.0 if j == {i} else 0.0" for i in range(count)),
        *(f"    {stage}" for stage in stages),
        *(f"    out[{i}, j] = dx[{i}] + h * ({slope.format(i)})" for i in range(count)),
        "out" if is_array(count, count) else matrix_of(count, count, lambda i, j: f"out[{i}, {j}]"),
    )
    return written_out("jacobian", "x, u, c", *lines, _loops=True, add=scaled_sum(count), np=np, **names)
