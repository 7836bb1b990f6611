"""Which states have a panel in a figure, and how axes name them."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from textwrap import wrap

from thruster_env.core.text_tables import verbatim
from thruster_env.model.quantities import Quantity

MOST_PANELS = 6  # of states in one figure
COLUMNS = 3  # of panels side by side
LABEL_WIDTH = 18  # characters of a line beside a panel


def plotted_states(
    states: Sequence[Quantity] | Sequence[str], scored: Collection[int] | None = None
) -> tuple[list[int], str]:
    """Indices of the states that a figure shows, in their order, and a line with the number of those left out.

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
    """Name and symbol above the unit, in lines as short as the axes of low panels have room for."""
    named = quantity.symbol in quantity.name.split()  # as "measured thrust" is
    label = verbatim(quantity.name) if named else quantity._replace(unit="").plot_label
    label = "\n".join(wrap(label, LABEL_WIDTH, break_long_words=False, break_on_hyphens=False))
    return f"{label}\n[{verbatim(quantity.unit)}]" if quantity.unit else label
