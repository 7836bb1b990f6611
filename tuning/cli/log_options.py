"""Options of commands that read recorded logs, declared once as dataclasses."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, is_dataclass
from functools import wraps
from inspect import Parameter, signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

from filters.starts import STARTS
from thruster_env.core.checks import short_repr
from thruster_env.logs.findings import OUTLIERS
from thruster_env.logs.recorders.one_clock import STAMPS
from tuning.cli.options import (
    A_LOG,
    INPUT,
    ColumnOption,
    HoldGapsOption,
    LogPresetOption,
    SensorOption,
    spelt,
)

if TYPE_CHECKING:
    from tuning.problems.problem import Problem


def with_groups(command: Callable) -> Callable:
    """Let a command take dataclasses of options; Typer reads their fields in its signature."""
    hints = get_type_hints(command, include_extras=True)
    groups: dict[str, Any] = {name: hint for name, hint in hints.items() if is_dataclass(hint)}
    parameters: list[Parameter] = []
    for parameter in signature(command).parameters.values():
        if parameter.name not in groups:
            parameters.append(
                parameter.replace(annotation=hints[parameter.name], kind=Parameter.POSITIONAL_OR_KEYWORD)
            )
            continue
        of_fields = get_type_hints(groups[parameter.name], include_extras=True)
        for part in fields(groups[parameter.name]):
            kind, hint = Parameter.POSITIONAL_OR_KEYWORD, of_fields[part.name]
            parameters.append(Parameter(part.name, kind, default=part.default, annotation=hint))
    flat = signature(command).replace(parameters=parameters)

    @wraps(command)
    def with_fields(*args, **kwargs):
        bound = flat.bind(*args, **kwargs)
        bound.apply_defaults()
        arguments = bound.arguments
        of_groups = {
            name: group(**{part.name: arguments.pop(part.name) for part in fields(group)})
            for name, group in groups.items()
        }
        return command(**arguments, **of_groups)

    taking: Any = with_fields
    taking.__signature__ = flat
    taking.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return taking


@dataclass(frozen=True)
class ReadingOptions:
    """How a log is read."""

    preset: LogPresetOption = None
    model: Annotated[
        str | None,
        typer.Option(
            "--model",
            metavar="MODULE:OBJECT",
            help="Instead of a thruster: a StateSpaceModel, or a function that returns one (called with dt if it "
            "has that argument).",
            rich_help_panel=INPUT,
        ),
    ] = None
    sensor: SensorOption = None
    column: ColumnOption = None
    clock_offset: Annotated[
        list[str] | None,
        typer.Option(
            "--clock-offset",
            metavar="NAME=SECONDS",
            help="Offset of a channel's clock, positive if it is ahead.",
            rich_help_panel=INPUT,
        ),
    ] = None
    dt: Annotated[
        float | None,
        typer.Option(
            "--dt",
            help="Sample time [s] of a log without times, or of the grid for irregular ones. Variances are per "
            "step of it.",
            rich_help_panel=INPUT,
        ),
    ] = None

    stamps: Annotated[
        str | None,
        typer.Option(
            help="Clock of all topics of a bag: header (stamps of their headers) or receipt (when messages were "
            "received); by default that of the headers if all have one clock.",
            callback=spelt(STAMPS),
            rich_help_panel=INPUT,
        ),
    ] = None

    def named(self) -> dict[str, Any]:
        """The arguments of `tuning.logs.read.read_named`."""
        of_model = {"preset": self.preset, "model": self.model, "sensors": self.sensor}
        of_times = {"clock_offset": self.clock_offset, "dt": self.dt, "stamps": self.stamps}
        return {**of_model, "columns": self.column, **of_times}


@dataclass(frozen=True)
class GridOptions(ReadingOptions):
    """How a log is read, and whether it is put on a grid."""

    no_grid: Annotated[
        bool,
        typer.Option(
            "--no-grid",
            help="Use the log's own time stamps, for a model in continuous time; variances are per step of --dt.",
            rich_help_panel=INPUT,
        ),
    ] = False

    def named(self) -> dict[str, Any]:
        """The arguments of `tuning.logs.read.read_named`."""
        return {**super().named(), **({"grid": False} if self.no_grid else {})}


@dataclass(frozen=True)
class BlockOptions:
    """Logs in place of a problem, and how they are cut into blocks."""

    log: Annotated[
        list[Path] | None,
        typer.Option(
            "--log",
            help=f"Instead of a problem: a recorded run; may be repeated. {A_LOG}",
            rich_help_panel=INPUT,
        ),
    ] = None
    held_out: Annotated[
        list[Path] | None,
        typer.Option(
            "--held-out",
            help="Held-out recorded run, never used by the study; by default every third one.",
            rich_help_panel=INPUT,
        ),
    ] = None
    blocks: Annotated[
        int | None,
        typer.Option(
            "--blocks",
            help="Number of blocks per run; about 72 in total by default.",
            rich_help_panel=INPUT,
        ),
    ] = None
    lead: Annotated[
        int | None,
        typer.Option(
            "--lead",
            help="Number of rows at the beginning of a block that are not scored; 50 by default.",
            rich_help_panel=INPUT,
        ),
    ] = None
    hold_gaps: HoldGapsOption = False
    start: Annotated[
        str | None,
        typer.Option(
            "--start",
            help="Initial state of blocks: prior, or measurement, from their first measurement, the default of "
            "ekf-robust.",
            callback=spelt(STARTS),
            rich_help_panel=INPUT,
        ),
    ] = None
    outliers: Annotated[
        str | None,
        typer.Option(
            "--outliers",
            help="Samples that thruster log calls outliers: kept, or missing, which leaves them out.",
            callback=spelt(OUTLIERS),
            rich_help_panel=INPUT,
        ),
    ] = None

    def named(self) -> dict[str, Any]:
        """Other arguments of `tuning.logs.problem.log_problem`; None where an option is not given."""
        cuts = {"held_out": self.held_out, "blocks": self.blocks, "lead": self.lead, "start": self.start}
        return {**cuts, "hold_gaps": self.hold_gaps or None, "outliers": self.outliers}


# Recorded logs as the problem of a study: from the options of a command, or as a tuned file names them.


def problems_of(
    names: Sequence[str] | None, logs: BlockOptions, reading: GridOptions, default: str
) -> tuple[Problem, ...]:
    """The problems of a study: logs with their options, or problems by name."""
    from tuning.logs.problem import log_problem
    from tuning.problems.find import find_problem
    from tuning.thruster.logs import of_preset

    options = {**reading.named(), **logs.named()}
    chosen = {name: value for name, value in options.items() if value is not None}
    if logs.log:
        if names:
            raise ValueError(
                f"a study must be of --log or of --problem, but got both, {logs.log[0]} and {names[0]}"
            )
        return (log_problem(logs.log, **chosen),)
    preset = chosen.pop("preset", None)
    if chosen:
        first = next(iter(chosen))
        option = {"sensors": "sensor", "columns": "column", "grid": "no-grid"}.get(first, first).replace("_", "-")
        value = "" if first == "grid" else f" {short_repr(chosen[first])}"
        raise ValueError(f"--{option} must come with --log, but got --{option}{value} without one")
    return tuple(of_preset(find_problem(name), preset) for name in names or [default])
