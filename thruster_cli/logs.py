"""What commands on logs share: whose log it is, which column is what, and the clocks."""

from __future__ import annotations

from typing import Annotated

import typer

from thruster_env.parameters import PRESETS
from tuning.logs.read import pairs, read_named

__all__ = ["pairs", "read_named"]

LogPresetOption = Annotated[
    str | None,
    typer.Option(
        "--preset", help=f"The thruster that it is of: {', '.join(PRESETS)}, or a FILE.toml of `identify`."
    ),
]
ModelOption = Annotated[
    str | None,
    typer.Option(
        "--model",
        metavar="MODULE:OBJECT",
        help="In place of a thruster: a StateSpaceModel, or a function that makes one (of dt, if it takes it).",
    ),
]
SensorOption = Annotated[
    list[str] | None, typer.Option("--sensor", help="What the filter sees of a thruster: thrust, speed, ...")
]
ColumnOption = Annotated[
    list[str] | None,
    typer.Option(
        "--column",
        metavar="NAME=HEADER[UNIT]",
        help="Which column is which input, measurement, state or output; may be repeated.",
    ),
]
ClockOption = Annotated[
    list[str] | None,
    typer.Option("--clock-offset", metavar="NAME=SECONDS", help="How far the clock of a channel is ahead."),
]
DtOption = Annotated[
    float | None, typer.Option("--dt", help="Sample time [s]: of a log without times, or to put it on.")
]
