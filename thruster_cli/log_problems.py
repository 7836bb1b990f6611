"""Recorded logs as the problem of a study: from the options of a command, or as a tuned file names them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import typer

from thruster_cli.presets import of_preset
from tuning.logs.problem import log_problem, problems_in
from tuning.problems.find import find_problem
from tuning.problems.problem import Problem

__all__ = ["problems_in", "problems_of"]

LogOption = Annotated[
    list[Path] | None,
    typer.Option("--log", help="In place of a problem: a recorded run, .csv, .parquet or .npz; may be repeated."),
]
HeldOutOption = Annotated[
    list[Path] | None,
    typer.Option("--held-out", help="Recorded run that only proves the choice; by default every third one."),
]
BlocksOption = Annotated[
    int | None, typer.Option("--blocks", help="How many blocks a run is cut into; about 24 in all by default.")
]
LeadOption = Annotated[
    int | None, typer.Option("--lead", help="Rows at the beginning of a block that do not count; 50 by default.")
]
LogModelOption = Annotated[
    str | None,
    typer.Option(
        "--model", metavar="MODULE:OBJECT", help="The model of the logs that it was tuned on, where that is code."
    ),
]


def problems_of(
    names: Sequence[str] | None, logs: Sequence[Path] | None, options: Mapping, default: str
) -> tuple[Problem, ...]:
    """What a study is for: logs with their options, or problems by name."""
    given = {name: value for name, value in options.items() if value is not None}
    if logs:
        if names:
            raise ValueError(f"a study must be of --log or of --problem, but got both, {logs[0]} and {names[0]}")
        return (log_problem(logs, **given),)
    preset = given.pop("preset", None)
    if given:
        first = next(iter(given))
        option = {"sensors": "sensor", "columns": "column"}.get(first, first).replace("_", "-")
        raise ValueError(f"--{option} must come with --log, but there is none")
    return tuple(of_preset(find_problem(name), preset) for name in names or [default])
