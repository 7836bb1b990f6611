"""Options that several commands share, and the panels that group them in `--help`.

Each command lists its options in its own signature, because Typer reads them there; their texts are here alone.
Those of recorded logs, which go together, are in `tuning/cli/log_options.py`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Annotated

import typer

from filters.monitoring.monitor import Monitor, monitor_of, tuned_monitor
from filters.registry import FILTERS
from thruster_env.core.checks import any_case
from thruster_env.thruster.channels import CHANNELS
from thruster_env.thruster.parameters import PRESETS

# Panels, in the order in which commands declare their options.
INPUT, FILTER, SEARCH, LEARNING, RUNS, OUTPUT = "Input", "Filter", "Search", "Learning", "Runs", "Output"


def one_file(argument: Path | None, option: Path | None) -> Path | None:
    """The tuned file, given as an argument or by --tuned; ValueError if both are."""
    if argument is not None and option is not None:
        raise ValueError(f"a tuned file must be one, but got {argument} and --tuned {option}")
    return argument or option


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
TUNED = "tuned"  # of --monitor
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


def asked_monitor(argument: str | None, tuned: Path | None) -> Monitor | None:
    """The monitor of --monitor: steps between false alarms, or that of the tuned file."""
    if argument != TUNED:
        try:
            return monitor_of(None if argument is None else float(argument))
        except ValueError as error:
            raise ValueError(f"--monitor must be steps, or {TUNED!r}, but got {argument}: {error}") from None
    if tuned is None:
        raise ValueError(f"--monitor {TUNED} must come with a tuned file, but got none")
    return tuned_monitor(tuned)
