"""Control of an ensemble's spread: inflation by a factor a step, and relaxation to the spread before an update.

Each takes a function of a page and returns one that does more.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

from filters.algebra.members import mean, stretches, variances


@cache
def inflated(settle: Callable) -> Callable:
    """The end of a step, then x = mean + inflation (x - mean)."""

    def settle_inflated(model, x, w):
        x = settle(model, x, w)
        return mean(x) + (x - mean(x)) * model.own.inflation

    return settle_inflated


@cache
def relaxed(update: Callable) -> Callable:
    """An update, then x = mean + (1 + relaxation (b - a)/a) (x - mean), by components.

    b and a are the sample standard deviations before and after the update. Where a component has no spread after
    it, it keeps none. The means stay.
    """

    def update_relaxed(model, x, z, e):
        after, *told = update(model, x, z, e)
        factors = stretches(variances(x), variances(after), model.own.relaxation)
        return mean(after) + (after - mean(after)) * factors, *told

    return update_relaxed
