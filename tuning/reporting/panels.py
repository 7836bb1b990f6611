"""Which states have a panel in a figure, and how axes name them."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from plants.quantities import Quantity

MOST_PANELS = 6  # of states in one figure
COLUMNS = 3  # of panels side by side


def shown_states(
    states: Sequence[Quantity] | Sequence[str], scored: Collection[int] | None = None
) -> tuple[list[int], str]:
    """Places of the states that a figure shows, in their order, and a line that says how many it leaves out.

    Args:
        states: all of them.
        scored: places of those that count in the score, which come first where not all are shown; all if None.
    """
    everyone = range(len(states))
    if len(states) <= MOST_PANELS:
        return list(everyone), ""
    first = sorted(everyone, key=lambda i: scored is not None and i not in scored)[:MOST_PANELS]
    return sorted(first), f"{len(states) - MOST_PANELS} of {len(states)} states are left out"


def axis_label(quantity: Quantity) -> str:
    """Name and symbol above the unit, as axes of narrow panels have it."""
    named = quantity.symbol in quantity.name.split()  # as "measured thrust" is
    label = quantity.name if named else quantity._replace(unit="").plot_label
    return f"{label}\n[{quantity.unit}]" if quantity.unit else label
