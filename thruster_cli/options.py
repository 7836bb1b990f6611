"""Options that several commands share, and the panels in which `--help` groups all of them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Annotated

import typer

from filters.registry import FILTERS
from numerics.checks import any_case
from thruster_env.channels import CHANNELS
from thruster_env.parameters import PRESETS

# Panels, in the order in which commands declare their options.
INPUT, FILTER, SEARCH, LEARNING, RUNS, OUTPUT = "Input", "Filter", "Search", "Learning", "Runs", "Output"


def one_file(argument: Path | None, option: Path | None) -> Path | None:
    """The tuned file, which may be given as an argument or by --tuned; ValueError where two are."""
    if argument is not None and option is not None:
        raise ValueError(f"a tuned file must be one, but got {argument} and --tuned {option}")
    return argument or option


def spelt(choices: Iterable[str]) -> Callable:
    """A callback of an option or argument that takes names of choices in upper or lower case."""
    known = tuple(choices)

    def callback(value):
        return [any_case(one, known) for one in value] if isinstance(value, list) else any_case(value, known)

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
    typer.Option("--seed", min=0, help="Seed of all randomness; the same seed repeats all.", rich_help_panel=RUNS),
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
CodeOption = Annotated[
    list[str] | None,
    typer.Option(
        "--problem",
        metavar="MODULE:OBJECT",
        help="What it was tuned on, where that is code: nothing that a file or a study names is imported.",
        rich_help_panel=INPUT,
    ),
]
FILTER_HELP = "Name of a filter; `thruster filters` lists them."


def filter_option(help_text: str):
    """The option `--filter`, whose names may be in upper or lower case."""
    return typer.Option("--filter", help=help_text, callback=spelt((*FILTERS, "auto")), rich_help_panel=FILTER)


# Of recorded runs
LogPresetOption = Annotated[
    str | None,
    typer.Option(
        "--preset", help=f"The thruster that it is of: {A_PRESET}", callback=spelt(PRESETS), rich_help_panel=INPUT
    ),
]
ModelOption = Annotated[
    str | None,
    typer.Option(
        "--model",
        metavar="MODULE:OBJECT",
        help="In place of a thruster: a StateSpaceModel, or a function that makes one (of dt, if it takes it).",
        rich_help_panel=INPUT,
    ),
]
SensorOption = Annotated[
    list[str] | None,
    typer.Option(
        "--sensor",
        help=f"What the filter sees of a thruster, thrust by default: {', '.join(CHANNELS)}.",
        rich_help_panel=INPUT,
    ),
]
ColumnOption = Annotated[
    list[str] | None,
    typer.Option(
        "--column",
        metavar="NAME=HEADER[UNIT]",
        help="Which column is which input, measurement, state or output; may be repeated.",
        rich_help_panel=INPUT,
    ),
]
ClockOption = Annotated[
    list[str] | None,
    typer.Option(
        "--clock-offset",
        metavar="NAME=SECONDS",
        help="How far the clock of a channel is ahead.",
        rich_help_panel=INPUT,
    ),
]
DtOption = Annotated[
    float | None,
    typer.Option(
        "--dt",
        help="Sample time [s]: of a log without times, or to put it on. Variances are per step of it.",
        rich_help_panel=INPUT,
    ),
]
LogOption = Annotated[
    list[Path] | None,
    typer.Option(
        "--log",
        help="In place of a problem: a recorded run, .csv, .parquet or .npz; may be repeated.",
        rich_help_panel=INPUT,
    ),
]
HeldOutOption = Annotated[
    list[Path] | None,
    typer.Option(
        "--held-out",
        help="Recorded run that the study never sees; by default every third one.",
        rich_help_panel=INPUT,
    ),
]
BlocksOption = Annotated[
    int | None,
    typer.Option(
        "--blocks",
        help="How many blocks a run is cut into; about 24 in all by default.",
        rich_help_panel=INPUT,
    ),
]
LeadOption = Annotated[
    int | None,
    typer.Option(
        "--lead",
        help="Rows at the beginning of a block that do not count; 50 by default.",
        rich_help_panel=INPUT,
    ),
]
LogModelOption = Annotated[
    str | None,
    typer.Option(
        "--model",
        metavar="MODULE:OBJECT",
        help="The model of the logs that it was tuned on, where that is code.",
        rich_help_panel=INPUT,
    ),
]
