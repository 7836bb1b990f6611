"""`thruster verify`: whether the metrics in a tuned file hold."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer
from rich.console import RenderableType

from thruster_env.core.text_tables import table
from tuning.cli.options import CodeOption, JsonOption, LogModelOption, TunedPresetOption
from tuning.cli.output import announce_compilation, emit, working
from tuning.evaluation.tuned import TOLERANCE, Verification, verify
from tuning.logs.problem import problems_in
from tuning.problems.find import find_problem

LISTED = 10  # differences in the table; --json has all


def command(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Tuned file, as `thruster tune` writes it.")],
    problem: CodeOption = None,
    model: LogModelOption = None,
    preset: TunedPresetOption = None,
    json: JsonOption = None,
) -> None:
    """Recompute the held-out metrics of a tuned file on its seeds, and say whether they hold.

    They hold if every number is the same within rounding; the exit code is then 0, otherwise 1. Packages
    whose versions have changed since the file was made are named.

    Example: thruster verify out/enkf-mismatch-seed0.json
    """
    announce_compilation()
    with working(f"recomputing the metrics of {file}"):
        found = verify(file, [*map(find_problem, problem or []), *problems_in(file, model, preset)])
    emit(_report(file, found), _as_json(file, found), json)
    if not found.holds:
        sys.exit(1)


def _report(file: Path, found: Verification) -> list[RenderableType]:
    shown: list[RenderableType] = []
    if found.holds:
        shown.append(f"{file} holds: {found.checked} numbers are the same within {TOLERANCE:g} of their size.")
    else:
        rows = [[d.place, str(d.stored), str(d.found), f"{d.relative:.1e}"] for d in found.differences[:LISTED]]
        shown.append(f"{file} does not hold: {len(found.differences)} of {found.checked} numbers differ.")
        shown.append(table("The largest differences", ["number", "stored", "found", "relative"], rows))
    if found.packages:
        changes = ", ".join(f"{name} {then} then, {now} now" for name, (then, now) in found.packages.items())
        shown.append(f"Packages whose versions have changed since the file was made: {changes}.")
    return shown


def _as_json(file: Path, found: Verification) -> dict:
    return {
        "file": str(file),
        "holds": found.holds,
        "checked": found.checked,
        "differences": [{**d._asdict(), "relative": d.relative} for d in found.differences],
        "packages": {name: {"stored": then, "here": now} for name, (then, now) in found.packages.items()},
    }
