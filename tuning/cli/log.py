"""`thruster log`: the contents and the problems of a recorded log."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer
from rich.console import RenderableType

from thruster_env.core.text_tables import console, table
from thruster_env.logs.findings import sentences
from thruster_env.logs.log import Log
from thruster_env.logs.write import check_suffix, write_log
from tuning.cli.fields import as_json, as_table, found_in, is_listed, remarks
from tuning.cli.log_options import ReadingOptions, with_groups
from tuning.cli.options import (
    A_LOG,
    INPUT,
    OUTPUT,
    JsonOption,
)
from tuning.cli.output import check_picture, check_targets, emit
from tuning.cli.printing import printed_whole
from tuning.logs.read import read_named


@with_groups
def command(
    log: Annotated[Path, typer.Argument(metavar="LOG", help=A_LOG)],
    *,
    reading: ReadingOptions,
    only: Annotated[
        str | None,
        typer.Option(
            metavar="TEXT",
            help="Of a recorder's file, list the fields whose names contain this.",
            rich_help_panel=INPUT,
        ),
    ] = None,
    plot: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Picture of all channels, findings marked: .png, .svg or .pdf.",
            rich_help_panel=OUTPUT,
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Write the log as it is read, on its grid and in the model's units: .csv, .npz or .parquet.",
            rich_help_panel=OUTPUT,
        ),
    ] = None,
    json: JsonOption = None,
) -> None:
    """Show how a recorded log is read: its channels, and the gaps, stuck sensors, outliers and the like in it.

    Other commands that read logs print the same before their results. docs/logs.md has the rules.

    For a recorder's file (PX4's .ulg, ArduPilot's .bin, ROS bags, MATLAB, HDF5) it lists topics and fields, unless
    options say how to read it; so it does for a table without any column of a thruster's. docs/recorders.md has
    the formats.

    Example: thruster log run.csv --plot run.png

    Example: thruster log run.csv --sensor speed --column speed=motor_rpm --column voltage=u_cmd_V

    Example: thruster log flight.ulg --only actuator
    """
    of_log = {key: value for key, value in reading.named().items() if key != "stamps"}
    if is_listed(log, only, any((*of_log.values(), plot, out))):
        check_targets((), json, read=(log,))
        some = found_in(log, only, reading.stamps)
        shown, said = as_table(log, some.fields, console.is_terminal), remarks(some)
        with printed_whole():
            emit([shown, *said] if console.is_terminal else [], as_json(log, some), json)
            if isinstance(shown, str) and json != "-":
                typer.echo("\n".join([shown, *said]))
        return
    if plot is not None:
        check_picture(plot, "--plot")
    if out is not None:
        check_suffix(out)
    recorded, _ = read_named(log, **reading.named())
    check_targets((plot, out), json, read=(log, reading.preset))
    if out is not None:
        write_log(out, recorded)
    if plot is not None:
        from thruster_env.logs.write import findings_figure

        findings_figure(plot, recorded)
    files = [str(one) for one in (plot, out) if one is not None]
    emit([*_report(recorded), *(f"wrote {one}" for one in files)], _as_json(recorded, files), json)


def _report(log: Log) -> list[RenderableType]:
    rows = []
    for channel in log.channels:
        values = log.series(channel).values
        kind, _, symbol = channel.partition(":")
        some = {"input": log.input_quantities, "measurement": log.measured}.get(kind, [*log.referred.values()])
        unit = next((one.unit for one in some if one.symbol == symbol), "")
        name = f"{kind} {symbol} [{unit}]" if unit else f"{kind} {symbol}"
        ends = [f"{values.min():.5g}", f"{values.max():.5g}", f"{values.std():.5g}"] if len(values) else [""] * 3
        rows.append([name, str(len(values)), *ends])
    on_grid = ", put on a grid" if log.irregular else ""
    title = f"{log.name}: {log.steps + 1} rows, dt {log.dt:g} s{on_grid}"
    columns = ["channel", "samples", "smallest", "largest", "standard\ndeviation"]
    said = sentences(log.findings) or ["Nothing stands out: no gaps, no stuck sensors, no outliers."]
    return [table(title, columns, rows), *said]


def _as_json(log: Log, files: list[str]) -> dict:
    return {
        "log": log.name,
        "digest": log.digest,
        "dt": log.dt,
        "rows": log.steps + 1,
        "irregular": log.irregular,
        "samples": {channel: len(log.series(channel).values) for channel in log.channels},
        "pieces": [list(piece) for piece in log.pieces],
        "findings": [asdict(one) for one in log.findings],
        "files": files,
    }
