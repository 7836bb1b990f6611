"""`thruster ways`: published ways of tuning, and when to use which."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from thruster_env.core.text_tables import table
from tuning.cli.options import JsonOption, spelt
from tuning.cli.output import emit
from tuning.ways.registry import WAYS, find_way
from tuning.ways.way import GRADIENT, TRUTH

NEEDS = "needs"
HEADS = ("way", "what it does", "use it", NEEDS)


def command(
    name: Annotated[str | None, typer.Argument(help="A way to show in full.", callback=spelt(WAYS))] = None,
    json: JsonOption = None,
) -> None:
    """List the ways of tuning of `thruster tune --way`, or show one with its equations and source.

    Those that need a gradient accept kf, ekf, iekf, ukf, ckf, ekf-robust, sage-husa and vb; searches accept any
    filter, the others any filter with a covariance.

    Example: thruster ways em
    """
    chosen = None if name is None else find_way(name)  # a clear error for an unknown one
    data: dict[str, Any] = {
        label: {"about": way.about, "when": way.when, "source": way.source, NEEDS: list(way.needs)}
        for label, way in WAYS.items()
        if name in (None, label)
    }
    if chosen is not None:
        text = (chosen.follow.__doc__ or "").strip()
        emit([f"{name}: {chosen.about}.", f"Use it {chosen.when}.", f"Source: {chosen.source}", text], data, json)
        return
    rows = [[label, way.about, way.when, _needs(way.needs)] for label, way in WAYS.items()]
    emit([table("ways of tuning: thruster tune --way NAME", HEADS, rows, words=True)], data, json)


def _needs(needs: tuple[str, ...]) -> str:
    words = {TRUTH: "true states", GRADIENT: "a gradient"}
    return ", ".join(words[need] for need in needs if need in words)
