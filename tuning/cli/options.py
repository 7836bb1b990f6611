"""Options that several commands share, and the panels that group them in `--help`.

Each command lists its options in its own signature, because Typer reads them there; their texts are here alone.
Those of recorded logs, which go together, are in `tuning/cli/options.py`.

Options of commands that read recorded logs, declared once as dataclasses.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields, is_dataclass
from functools import wraps
from inspect import Parameter, signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

from filters.registry import FILTERS
from filters.starts import STARTS
from thruster_env.core.checks import any_case, short_repr
from thruster_env.logs.findings import OUTLIERS
from thruster_env.logs.recorders.bags import STAMPS
from thruster_env.thruster.channels import CHANNELS
from thruster_env.thruster.parameters import PRESETS
from tuning.api.markers import FILTER, INPUT, LEARNING, OUTPUT, RUNS  # noqa: F401 - for commands

if TYPE_CHECKING:
    from tuning.problems.problem import Problem


def spelt(choices: Iterable[str]) -> Callable:
    """A callback for an option or argument that accepts names of choices in upper or lower case."""
    known = tuple(choices)

    def callback(value):
        return [any_case(choice, known) for choice in value] if isinstance(value, list) else any_case(value, known)

    return callback


JsonOption = Annotated[
    str | None,
    typer.Option(
        "--json",
        metavar="FILE",
        help="Also write the result as JSON; - for standard output.",
        rich_help_panel=OUTPUT,
    ),
]
SeedOption = Annotated[
    int,
    typer.Option(
        "--seed", min=0, help="Seed of all randomness; the same seed gives the same results.", rich_help_panel=RUNS
    ),
]
A_PRESET = f"{', '.join(PRESETS)}, or a FILE.toml of `thruster new preset` or `thruster identify`."
PresetOption = Annotated[
    str, typer.Option("--preset", help=A_PRESET, callback=spelt(PRESETS), rich_help_panel=INPUT)
]
OfPresetOption = Annotated[
    str | None,
    typer.Option(
        "--preset",
        help=f"The scenario of another thruster: {A_PRESET}",
        callback=spelt(PRESETS),
        rich_help_panel=INPUT,
    ),
]
TunedPresetOption = Annotated[
    str | None,
    typer.Option(
        "--preset",
        help="The preset with which it was tuned; by default as the tuned file names it.",
        callback=spelt(PRESETS),
        rich_help_panel=INPUT,
    ),
]
CodeOption = Annotated[
    list[str] | None,
    typer.Option(
        "--problem",
        metavar="MODULE:OBJECT",
        help="The problem it was tuned on, if that is code: names in files and studies are never imported.",
        rich_help_panel=INPUT,
    ),
]
FILTER_HELP = "Name of a filter; `thruster filters` lists them."


def filter_option(help_text: str):
    """The option `--filter`, whose names may be in upper or lower case."""
    return typer.Option("--filter", help=help_text, callback=spelt((*FILTERS, "auto")), rich_help_panel=FILTER)


# Of recorded runs
A_LOG = "A .csv, .parquet or .npz file with a header, or a recorder's: .ulg, .bin, .bag, .db3, .mcap, .mat, .h5."
LogPresetOption = Annotated[
    str | None,
    typer.Option(
        "--preset", help=f"The thruster of the log: {A_PRESET}", callback=spelt(PRESETS), rich_help_panel=INPUT
    ),
]
SensorOption = Annotated[
    list[str] | None,
    typer.Option(
        "--sensor",
        help=f"A thruster's sensor that the filter sees, thrust by default: {', '.join(CHANNELS)}.",
        rich_help_panel=INPUT,
    ),
]
ColumnOption = Annotated[
    list[str] | None,
    typer.Option(
        "--column",
        metavar="NAME=HEADER[UNIT]",
        help="The column of an input, measurement, state or output; may be repeated.",
        rich_help_panel=INPUT,
    ),
]
MonitorOption = Annotated[
    str | None,
    typer.Option(
        "--monitor",
        metavar="STEPS",
        help="Test for outliers, biases, changed noise, stuck and missing readings, with one false alarm in this "
        "number of steps, or 'tuned' for the tuned file's monitor (docs/monitoring.md).",
        rich_help_panel=RUNS,
    ),
]
HoldGapsOption = Annotated[
    bool,
    typer.Option(
        "--hold-gaps",
        help="Hold the last input over gaps of a log; by default runs are split there.",
        rich_help_panel=INPUT,
    ),
]
LogModelOption = Annotated[
    str | None,
    typer.Option(
        "--model",
        metavar="MODULE:OBJECT",
        help="The model of the logs that it was tuned on, if that is code.",
        rich_help_panel=INPUT,
    ),
]


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
