"""Bounds on the states of a model, which its estimates keep."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from thruster_env.core.checks import short_repr
from thruster_env.model.quantities import Quantity


class Bound(NamedTuple):
    """The smallest and the largest value that a state, by its index, can have; infinite where there is none."""

    place: int
    low: float
    high: float


def checked_bounds(given: Any, states: Sequence[Quantity]) -> tuple[Bound, ...]:
    """Bounds in the order of the states, from a mapping of symbols or indices to pairs, of which None is no bound.

    Raises ValueError for another state, an angle, or a pair that is not increasing numbers.
    """
    if not isinstance(given, Mapping):  # those of another model
        given = {one[0]: one[1:] for one in given}
    symbols, found = [one.symbol for one in states], []
    for name, pair in given.items():
        place = symbols.index(name) if name in symbols else name
        if not isinstance(place, int) or not 0 <= place < len(states) or states[place].angle:
            known = ", ".join(one.symbol for one in states if not one.angle)
            raise ValueError(f"bounds must be of states {known}, and not of angles, but got {short_repr(name)}")
        try:
            low, high = pair
            low, high = (-math.inf if low is None else float(low)), (math.inf if high is None else float(high))
        except (TypeError, ValueError):
            low = high = math.nan
        if not low < high or low == math.inf or high == -math.inf:
            rule = f"bounds of {symbols[place]} must be two increasing numbers, of which one may be None"
            raise ValueError(f"{rule}, but got {short_repr(pair)}")
        if low > -math.inf or high < math.inf:
            found.append(Bound(place, low, high))
    return tuple(sorted(found))
