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
        result = verify(file, [*map(find_problem, problem or []), *problems_in(file, model, preset)])
    emit(_report(file, result), _as_json(file, result), json)
    if not result.holds:
        sys.exit(1)


def _report(file: Path, result: Verification) -> list[RenderableType]:
    output: list[RenderableType] = []
    if result.holds:
        output.append(f"{file} holds: {result.checked} numbers are the same within {TOLERANCE:g} of their size.")
    else:
        rows = [[d.place, str(d.stored), str(d.found), f"{d.relative:.1e}"] for d in result.differences[:LISTED]]
        output.append(f"{file} does not hold: {len(result.differences)} of {result.checked} numbers differ.")
        output.append(table("The largest differences", ["number", "stored", "found", "relative"], rows))
    if result.packages:
        changes = ", ".join(f"{name} {then} then, {now} now" for name, (then, now) in result.packages.items())
        output.append(f"Packages whose versions have changed since the file was made: {changes}.")
    return output


def _as_json(file: Path, result: Verification) -> dict:
    return {
        "file": str(file),
        "holds": result.holds,
        "checked": result.checked,
        "differences": [{**d._asdict(), "relative": d.relative} for d in result.differences],
        "packages": {name: {"stored": then, "here": now} for name, (then, now) in result.packages.items()},
    }
