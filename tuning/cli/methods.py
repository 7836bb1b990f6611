"""`thruster methods`: all methods of tuning, and when to use which."""

from __future__ import annotations

import inspect
from typing import Annotated, Any

from thruster_env.core.text_tables import Table
from tuning.api.markers import INPUT, Argument
from tuning.api.result import Printed
from tuning.methods.task import GRADIENT, METHODS, TRUTH, find_method

NEEDS = "needs"
HEADS = ("method", "what it does", "use it", NEEDS)


def command(name: Annotated[str | None, Argument(INPUT, choices=METHODS)] = None) -> Printed:
    """List the methods of tuning of `thruster tune --method`, or show one with its equations and source.

    Those that need a gradient accept kf, ekf, iekf, ukf, ckf, ekf-robust, sage-husa and vb; searches accept any
    filter, the others any filter with a covariance.

    Example: thruster methods em

    Args:
        name: a method to show in full.
    """
    chosen = None if name is None else find_method(name)  # a clear error for an unknown one
    data: dict[str, Any] = {
        label: {"about": method.about, "when": method.when, "source": method.source, NEEDS: list(method.needs)}
        for label, method in METHODS.items()
        if name in (None, label)
    }
    if chosen is not None:
        text = inspect.getdoc(chosen.function) or ""
        words = [f"{name}: {chosen.about}.", f"Use it {chosen.when}.", f"Source: {chosen.source}", text]
        return Printed(words, data)
    rows = [[label, method.about, method.when, _needs(method.needs)] for label, method in METHODS.items()]
    return Printed([Table("methods of tuning: thruster tune --method NAME", HEADS, rows, words=True)], data)


def _needs(needs: tuple[str, ...]) -> str:
    words = {TRUTH: "true states", GRADIENT: "a gradient"}
    return ", ".join(words[need] for need in needs if need in words)
