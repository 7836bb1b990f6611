"""Runge-Kutta integration of rates written on tuples of components."""

from __future__ import annotations

from collections.abc import Callable

from numerics.compiled import inlined
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
