"""`thruster study users`: whether tuning is ever worse than what a user had, on problems of users."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from thruster_env.core.text_tables import table
from tuning.cli.options import INPUT, OUTPUT, RUNS, JsonOption
from tuning.cli.output import announce_compilation, emit, progress_console

RESULTS = Path("out") / "users"


def command(
    problem: Annotated[
        list[str] | None,
        typer.Option(
            "--problem",
            metavar="MODULE:OBJECT",
            help="A problem, may be repeated; by default the twelve of tests/users in a checkout of the project.",
            rich_help_panel=INPUT,
        ),
    ] = None,
    filters: Annotated[
        list[str] | None,
        typer.Option(
            "--filter",
            help="A filter, may be repeated; by default ekf, ukf, enkf, ekf-robust.",
            rich_help_panel=RUNS,
        ),
    ] = None,
    trials: Annotated[
        int | None, typer.Option(min=1, max=1_000_000, help="Trials of each study; 50.", rich_help_panel=RUNS)
    ] = None,
    seed: Annotated[
        int, typer.Option("--seed", min=0, max=2**31 - 1, help="Seed of all studies.", rich_help_panel=RUNS)
    ] = 0,
    quick: Annotated[
        bool,
        typer.Option(
            "--quick",
            help="Two problems, one filter, four trials: a test run without meaningful results.",
            rich_help_panel=RUNS,
        ),
    ] = False,
    out: Annotated[
        Path,
        typer.Option(
            help="Folder of results; existing ones are not recomputed. Use another one after changes in the code.",
            rich_help_panel=OUTPUT,
        ),
    ] = RESULTS,
    json: JsonOption = None,
) -> None:
    """Tune filters on users' problems, and compare each with its user's baselines.

    The table has the held-out score of the tuned filter over that of each baseline, with 95 % intervals paired by
    run; "!" marks significantly worse ones, by Holm's procedure at 5 % over the whole table. Ctrl-C keeps
    finished cases, and the same command continues. All cases take about an hour on one core.

    Example: thruster study users --quick
    """
    from thruster_env.core.files import check_target, write_whole
    from tuning.experiments.users import (
        QUICK,
        Panel,
        csv_text,
        header,
        markdown,
        rows_of,
        run_panel,
        sentences,
    )

    arguments: dict[str, Any] = {"problems": problem, "filters": filters, "trials": trials, "seed": seed}
    changes: dict[str, Any] = {
        name: tuple(value) if isinstance(value, list) else value for name, value in arguments.items() if value
    }
    panel = (QUICK if quick else Panel())._replace(**changes)
    files = out / "users.csv", out / "users.md"
    for file in files:
        check_target(file)
    announce_compilation()
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()
    try:
        with Progress(*columns, console=progress_console) as progress:
            bar = progress.add_task("tuning", total=None)
            cases = run_panel(
                panel,
                out,
                lambda text, done, count: progress.update(bar, description=text, completed=done, total=count),
            )
            progress.update(bar, description="tuned", completed=len(cases), total=len(cases))
    except KeyboardInterrupt:
        progress_console.print(f"Interrupted: finished work is in {out}, and the same command continues.")
        raise
    for file, text in zip(files, (csv_text(cases), markdown(cases) + "\n"), strict=True):
        write_whole(file, text)
    conclusions = sentences(cases)
    heads, rows = header(cases), rows_of(cases)
    data = {
        "cases": [
            {
                **case._asdict(),
                "baselines": {
                    name: {**paired.ratio._asdict(), "chance": paired.chance}
                    for name, paired in case.baselines.items()
                },
            }
            for case in cases
        ],
        "answers": conclusions,
        "files": [str(file) for file in files],
    }
    title = f"scores of tuned filters over those of baselines, held out; {panel.trials} trials"
    emit([table(title, heads, rows), *conclusions, *[f"wrote {file}" for file in files]], data, json)
