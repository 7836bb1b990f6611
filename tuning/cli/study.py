"""`thruster study`: long comparisons."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from thruster_env.core.text_tables import table
from tuning.cli import methods_study, recordings, users
from tuning.cli.app import Command, Group
from tuning.cli.options import OUTPUT, RUNS, JsonOption
from tuning.cli.output import announce_compilation, emit, progress_console

RESULTS = Path("out") / "comparison"

app = typer.Typer(cls=Group, help="Long comparisons.", no_args_is_help=True)


@app.callback()
def _callback() -> None:
    pass


app.command("recordings", cls=Command)(recordings.command)
app.command("users", cls=Command)(users.command)
app.command("methods", cls=Command)(methods_study.command)


@app.command("policies", cls=Command)
def policies(
    quick: Annotated[
        bool,
        typer.Option(
            "--quick",
            help="One noise, two seeds, few steps: a test run without meaningful results.",
            rich_help_panel=RUNS,
        ),
    ] = False,
    seeds: Annotated[
        int | None,
        typer.Option(
            min=1, max=1000, help="Training seeds of each learned policy; 5 by default.", rich_help_panel=RUNS
        ),
    ] = None,
    steps: Annotated[
        int | None,
        typer.Option(
            min=1,
            max=10**12,
            help="Training steps of each policy; by default those of `thruster train`.",
            rich_help_panel=RUNS,
        ),
    ] = None,
    recurrent: Annotated[
        bool,
        typer.Option(
            "--recurrent", help="Also PPO with an LSTM on raw measurements: many hours.", rich_help_panel=RUNS
        ),
    ] = False,
    jobs: Annotated[
        int | None,
        typer.Option(min=1, max=1000, help="Number of processes; as many as cores.", rich_help_panel=RUNS),
    ] = None,
    out: Annotated[
        Path, typer.Option(help="Folder of results; existing ones are not recomputed.", rich_help_panel=OUTPUT)
    ] = RESULTS,
    page: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.md",
            help="Page whose tables are rewritten, with the pictures beside it.",
            rich_help_panel=OUTPUT,
        ),
    ] = None,
    json: JsonOption = None,
) -> None:
    """Train policies on raw, filtered and true state, and compare them with model-predictive control, PI and LQG.

    It trains PPO at three noise levels of the thrust sensor, SAC, and policies that correct the controller, scores
    all on the same held-out episodes, and writes a page with tables and two pictures. Ctrl-C keeps finished work,
    and the same command continues. On two cores it takes an hour or more.

    Example: thruster study policies --quick
    """
    from tuning.policies.algorithms import check_installed

    check_installed()
    from tuning.policies.comparison import QUICK, Comparison, run_comparison
    from tuning.policies.comparison_report import (
        HEADER,
        PAGE,
        answers,
        check_page,
        rows_of,
        summary_rows,
        write_report,
    )

    comparison = QUICK if quick else Comparison()
    changes: dict[str, Any] = {"seeds": seeds, "steps": steps, "recurrent": recurrent or None}
    comparison = comparison._replace(**{name: value for name, value in changes.items() if value is not None})
    target = page or out / PAGE
    check_page(target)
    announce_compilation()
    columns = [
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    ]
    try:
        with Progress(*columns, console=progress_console) as progress:
            task = progress.add_task("policies", total=None)
            results = run_comparison(
                comparison,
                out,
                jobs,
                lambda run, done, count: progress.update(task, description=run.name, completed=done, total=count),
            )
    except KeyboardInterrupt:
        progress_console.print(f"Interrupted: finished work is in {out}, and the same command continues.")
        raise
    written = write_report(results, comparison, target, rough=quick)
    rows = {noise: rows_of(results, noise) for noise in comparison.noises}
    conclusions, files = answers(results), [str(path) for path in written]
    summary = summary_rows(results)
    tables = [table(f"{noise} noise; thrust errors in N", HEADER, rows[noise]) for noise in rows]
    data = {
        "policies": {noise: [dict(zip(HEADER, row, strict=True)) for row in rows[noise]] for noise in rows},
        "summary": summary,
        "answers": conclusions,
        "files": files,
    }
    tables.append(table("in short, with 95 % intervals", ["", *comparison.noises], summary))
    emit([*tables, *conclusions, *[f"wrote {path}" for path in files]], data, json)
