"""`thruster ways`: published ways of tuning, and when to use which."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from thruster_cli.options import JsonOption, spelt
from thruster_cli.output import emit, table
from tuning.ways.registry import WAYS
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
    data: dict[str, Any] = {
        one: {"about": way.about, "when": way.when, "source": way.source, NEEDS: list(way.needs)}
        for one, way in WAYS.items()
        if name in (None, one)
    }
    if name is not None:
        way = WAYS[name]
        text = (way.follow.__doc__ or "").strip()
        emit([f"{name}: {way.about}.", f"Use it {way.when}.", f"Source: {way.source}", text], data, json)
        return
    rows = [[one, way.about, way.when, _needs(way.needs)] for one, way in WAYS.items()]
    emit([table("ways of tuning: thruster tune --way NAME", HEADS, rows, words=True)], data, json)


def _needs(needs: tuple[str, ...]) -> str:
    words = {TRUTH: "true states", GRADIENT: "a gradient"}
    return ", ".join(words[one] for one in needs if one in words)
