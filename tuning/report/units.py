"""Units of the numbers that a study chooses, from the names and units of a model."""

from __future__ import annotations

import re

from plants.quantities import Quantities, Quantity
from tuning.problems.parameter import squared

VARIANCE = re.compile(r"(Q|R)(?:(\d+)\2)?")  # Q11, Q22, ..., Q1111 of state 11; R, or R11, R22, ...


def labelled(name: str, quantities: Quantities, square: str = "^2") -> str:
    """A trial parameter in words with its unit: Q11 is a variance of the first state, R of the measurement.

    Args:
        name: of the parameter.
        quantities: of the model.
        square: what stands for "squared".
    """
    words, unit = name.replace("_", " "), squared(_unit(name, quantities)).replace("^2", square)
    return f"{words} [{unit}]" if unit else words


def _unit(name: str, quantities: Quantities) -> str:
    """The unit of which a parameter is the square; empty for all that is no variance, and for pure numbers."""
    found = VARIANCE.fullmatch(name)
    if found is None:
        return ""
    of: tuple[Quantity, ...] = quantities.states if found[1] == "Q" else quantities.measurements
    place = int(found[2] or 1) - 1
    return of[place].unit if place < len(of) else ""
