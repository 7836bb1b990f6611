"""`thruster study recordings`: thrust of the recorded ROV thruster, estimated without its load cell."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from thruster_env.core.files import check_target
from thruster_env.core.text_tables import table
from tuning.cli.options import INPUT, OUTPUT, RUNS, JsonOption
from tuning.cli.output import announce_compilation, emit, progress_console

RESULTS = Path("out") / "recordings.json"


def command(
    data: Annotated[
        Path,
        typer.Option(
            help="Folder with the recorded runs as .csv files, or with a folder closed_loop_25Hz.",
            rich_help_panel=INPUT,
        ),
    ],
    identify: Annotated[
        bool,
        typer.Option(
            "--identify",
            help="Identify all parameters again, of nine structures, with and without each run: a quarter of "
            "an hour.",
            rich_help_panel=RUNS,
        ),
    ] = False,
    out: Annotated[
        Path,
        typer.Option(
            help="With --identify: file of results; existing ones are not recomputed.", rich_help_panel=OUTPUT
        ),
    ] = RESULTS,
    json: JsonOption = None,
) -> None:
    """Compare estimates of a recorded thruster's thrust with its load cell, and with the recorder's own estimate.

    The filter sees command and tachometer. By default its parameters are the project's, identified from six runs;
    with --identify, each run is estimated with parameters identified without that run. The recordings are those of
    J. A. Boehm (University of Maryland, 2019), which are not part of this project: see docs/real_data.md.

    Example: thruster study recordings --data rov_thruster
    """
    from tuning.experiments.recordings.identification import estimates_of, identify_all
    from tuning.experiments.recordings.model import read_recordings
    from tuning.experiments.recordings.tables import sentences, tables_of

    runs = read_recordings(data)
    if identify:
        check_target(out)
    announce_compilation()
    tasks = None
    if identify:
        columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()
        try:
            with Progress(*columns, console=progress_console) as progress:
                bar = progress.add_task("identifying", total=None)
                tasks = identify_all(
                    runs,
                    out,
                    progress=lambda name, done, count: progress.update(
                        bar, description=name, completed=done, total=count
                    ),
                )
        except KeyboardInterrupt:
            progress_console.print(f"Interrupted: finished work is in {out}, and the same command continues.")
            raise
    estimates = estimates_of(runs, tasks)
    which = "parameters identified without the run" if identify else "the project's parameters"
    titles = {
        "ratios": f"RMSE of thrust over 0.2 s; {which}",
        "estimators": "RMSE over 0.2 s, N: all rows / settled",
        "clocks": "how far the load cell's clock is ahead",
        "structures": "the contribution of each effect",
        "numbers": "numbers found",
    }
    tables = tables_of(runs, estimates, tasks)
    output = [table(titles[name], *content) for name, content in tables.items()]
    named = {
        name: [dict(zip(content.header, row, strict=True)) for row in content.rows]
        for name, content in tables.items()
    }
    answers = sentences(estimates, runs)
    emit([*output, *answers], {**named, "answers": answers}, json)
