"""Recorded logs as the problem of a study: from the options of a command, or as a tuned file names them."""

from __future__ import annotations

from collections.abc import Sequence

from thruster_env.core.checks import short_repr
from tuning.cli.log_options import BlockOptions, GridOptions
from tuning.logs.problem import log_problem
from tuning.problems.find import find_problem
from tuning.problems.problem import Problem
from tuning.thruster.logs import of_preset


def problems_of(
    names: Sequence[str] | None, logs: BlockOptions, reading: GridOptions, default: str
) -> tuple[Problem, ...]:
    """The problems of a study: logs with their options, or problems by name."""
    options = {**reading.named(), **logs.named()}
    given = {name: value for name, value in options.items() if value is not None}
    if logs.log:
        if names:
            raise ValueError(
                f"a study must be of --log or of --problem, but got both, {logs.log[0]} and {names[0]}"
            )
        return (log_problem(logs.log, **given),)
    preset = given.pop("preset", None)
    if given:
        first = next(iter(given))
        option = {"sensors": "sensor", "columns": "column", "grid": "no-grid"}.get(first, first).replace("_", "-")
        value = "" if first == "grid" else f" {short_repr(given[first])}"
        raise ValueError(f"--{option} must come with --log, but got --{option}{value} without one")
    return tuple(of_preset(find_problem(name), preset) for name in names or [default])
