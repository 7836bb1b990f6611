"""`thruster methods`: all methods of tuning, and when to use which."""

from __future__ import annotations

import inspect
from typing import Annotated, Any

import typer

from thruster_env.core.text_tables import table
from tuning.cli.options import JsonOption, spelt
from tuning.cli.output import emit
from tuning.methods.registry import GRADIENT, METHODS, TRUTH, find_method

NEEDS = "needs"
HEADS = ("method", "what it does", "use it", NEEDS)


def command(
    name: Annotated[str | None, typer.Argument(help="A method to show in full.", callback=spelt(METHODS))] = None,
    json: JsonOption = None,
) -> None:
    """List the methods of tuning of `thruster tune --method`, or show one with its equations and source.

    Those that need a gradient accept kf, ekf, iekf, ukf, ckf, ekf-robust, sage-husa and vb; searches accept any
    filter, the others any filter with a covariance.

    Example: thruster methods em
    """
    chosen = None if name is None else find_method(name)  # a clear error for an unknown one
    data: dict[str, Any] = {
        label: {"about": method.about, "when": method.when, "source": method.source, NEEDS: list(method.needs)}
        for label, method in METHODS.items()
        if name in (None, label)
    }
    if chosen is not None:
        text = inspect.getdoc(chosen.function) or ""
        emit([f"{name}: {chosen.about}.", f"Use it {chosen.when}.", f"Source: {chosen.source}", text], data, json)
        return
    rows = [[label, method.about, method.when, _needs(method.needs)] for label, method in METHODS.items()]
    emit([table("methods of tuning: thruster tune --method NAME", HEADS, rows, words=True)], data, json)


def _needs(needs: tuple[str, ...]) -> str:
    words = {TRUTH: "true states", GRADIENT: "a gradient"}
    return ", ".join(words[need] for need in needs if need in words)
