"""Solving h(x) = z for one component of x, by bracketing: for any continuous function, compiled or not."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache

from thruster_env.core.angles import wrapped
from thruster_env.core.compiled import inlined
from thruster_env.core.sources import Source

INTERVALS = 100  # on either side, in which a sign change is looked for
HALVINGS = 60  # of such an interval; and steps of the golden section, each of which leaves 0.618 of it
_GOLDEN = 0.6180339887498949


@lru_cache(maxsize=64)
def component_solver(observe: Callable, n: int, component: int, channel: int, angle: bool = False) -> Callable:
    """Return `solve(x, z, c, reach)`: x with the value of one component at which channel h_i(x) = z.

    It is the root nearest to the value in x, among those within `reach` of it whose sign change shows between two
    of 100 equal steps on either side. If there is none, it is the value at which h comes nearest to z, as found by
    a golden section about the nearest step. Where the channel is an `angle`, h_i(x) - z goes the short way round,
    and its jump half a turn away is no root.
    """
    source = Source("place", "x, v", result=(n,), x=(n,))
    place = source.function(source.vector(n, lambda i: source.if_same(i, component, "v", f"x[{i}]")))

    @inlined
    def misfit_of_number(x, v, z, c):
        return observe(place(x, v), c)[channel] - z

    @inlined
    def misfit_of_angle(x, v, z, c):
        return wrapped(observe(place(x, v), c)[channel] - z)

    @inlined
    def crossing_of_number(one, other):
        return (other > 0.0) != (one > 0.0)

    @inlined
    def crossing_of_angle(one, other):
        return (other > 0.0) != (one > 0.0) and abs(other - one) < math.pi

    misfit = misfit_of_angle if angle else misfit_of_number
    crossing = crossing_of_angle if angle else crossing_of_number

    @inlined
    def halved(x, z, c, one, other, at_one):
        for _ in range(HALVINGS):
            middle = 0.5 * (one + other)
            value = misfit(x, middle, z, c)
            if (value > 0.0) == (at_one > 0.0):
                one = middle
            else:
                other = middle
        return 0.5 * (one + other)

    @inlined
    def nearest_approach(x, z, c, low, high):
        for _ in range(HALVINGS):
            left, right = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
            if abs(misfit(x, left, z, c)) < abs(misfit(x, right, z, c)):
                high = right
            else:
                low = left
        return 0.5 * (low + high)

    @inlined
    def solve(x, z, c, reach):
        start, step = x[component], reach / INTERVALS
        below = above = misfit(x, start, z, c)
        nearest, least = start, abs(below)
        for k in range(1, INTERVALS + 1):
            next_below, next_above = misfit(x, start - k * step, z, c), misfit(x, start + k * step, z, c)
            crossed_below, crossed_above = crossing(below, next_below), crossing(above, next_above)
            if crossed_below or crossed_above:
                inner = (k - 1) * step
                down = halved(x, z, c, start - inner, start - k * step, below) if crossed_below else start - reach
                up = halved(x, z, c, start + inner, start + k * step, above) if crossed_above else start + reach
                return place(x, down if start - down < up - start else up)
            if abs(next_below) < least:
                nearest, least = start - k * step, abs(next_below)
            if abs(next_above) < least:
                nearest, least = start + k * step, abs(next_above)
            below, above = next_below, next_above
        low, high = max(nearest - step, start - reach), min(nearest + step, start + reach)
        finer = nearest_approach(x, z, c, low, high)
        return place(x, finer if abs(misfit(x, finer, z, c)) < least else nearest)

    return solve
