"""`thruster study`: long comparisons of problems of users, recordings, methods of tuning, and policies."""

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

from thruster_env.core.files import check_target
from thruster_env.core.text_tables import table
from tuning.cli.app import Command, Group
from tuning.cli.options import INPUT, OUTPUT, RUNS, JsonOption
from tuning.cli.output import announce_compilation, emit, progress_console

USERS_FOLDER = Path("out") / "users"


def users(
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
    ] = USERS_FOLDER,
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


RECORDINGS_FILE = Path("out") / "recordings.json"


def recordings(
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
    ] = RECORDINGS_FILE,
    json: JsonOption = None,
) -> None:
    """Compare estimates of a recorded thruster's thrust with its load cell, and with the recorder's own estimate.

    The filter sees command and tachometer. By default its parameters are the project's, identified from six runs;
    with --identify, each run is estimated with parameters identified without that run. The recordings are those of
    J. A. Boehm (University of Maryland, 2019), which are not part of this project: see docs/real_data.md.

    Example: thruster study recordings --data rov_thruster
    """
    from tuning.experiments.recordings.identification import estimates_of, identify_all, sentences, tables_of
    from tuning.experiments.recordings.model import read_recordings

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


METHODS_FOLDER = Path("out") / "methods"


def methods(
    groups: Annotated[str, typer.Option(help="Groups of problems.", rich_help_panel=RUNS)] = "ABCDEFGH",
    method: Annotated[
        list[str] | None,
        typer.Option("--method", help="A method, may be repeated; by default all.", rich_help_panel=RUNS),
    ] = None,
    sets: Annotated[int | None, typer.Option(min=2, max=20, help="Data sets; 20.", rich_help_panel=RUNS)] = None,
    runs: Annotated[
        float | None,
        typer.Option(min=100, max=1e7, help="Passes that a method may take; 1e5.", rich_help_panel=RUNS),
    ] = None,
    seconds: Annotated[
        float | None, typer.Option(min=0.1, max=1e4, help="Seconds of one core; 100.", rich_help_panel=RUNS)
    ] = None,
    many: Annotated[
        int | None, typer.Option(min=10, max=10**5, help="Runs of the reference; 2000.", rich_help_panel=RUNS)
    ] = None,
    starts: Annotated[
        int | None, typer.Option(min=1, max=100, help="Starts of the reference; 20.", rich_help_panel=RUNS)
    ] = None,
    jobs: Annotated[int, typer.Option(min=1, max=1000, help="Processes.", rich_help_panel=RUNS)] = 1,
    quick: Annotated[
        bool,
        typer.Option("--quick", help="A test run without meaningful results.", rich_help_panel=RUNS),
    ] = False,
    out: Annotated[
        Path,
        typer.Option(
            help="Folder of results, which several hosts may share; existing ones are not recomputed.",
            rich_help_panel=OUTPUT,
        ),
    ] = METHODS_FOLDER,
    page: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.md",
            help="Page whose tables are rewritten, with the picture beside it.",
            rich_help_panel=OUTPUT,
        ),
    ] = None,
    json: JsonOption = None,
) -> None:
    """Run every method of tuning on the same data within the same budget, and score it on held-out truth.

    The regret of a method is its score over that of the best constant parameters, found by gradients from many
    starts on many runs. Ctrl-C keeps finished results, and the same command continues. The whole study takes days;
    the options reduce it, and results of different budgets are stored separately.

    Example: thruster study methods --quick
    """
    from thruster_env.core.files import write_whole
    from thruster_env.core.text_tables import with_tables
    from tuning.experiments.methods.problems import FAST, PREDICTIONS, Protocol
    from tuning.experiments.methods.runs import run_protocol
    from tuning.experiments.methods.tables import figure, tables

    protocol = FAST if quick else Protocol()
    changes: dict[str, Any] = {"sets": sets, "runs": runs, "seconds": seconds, "many": many, "starts": starts}
    changes["methods"] = tuple(method) if method else None
    changes["cases"] = tuple(case for case in protocol.cases if case.group in groups) or None
    protocol = protocol._replace(**{name: value for name, value in changes.items() if value is not None})
    text = None if page is None else page.read_text(encoding="utf-8")
    announce_compilation()
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()
    try:
        with Progress(*columns, console=progress_console) as progress:
            bar = progress.add_task("methods", total=None)
            results = run_protocol(
                protocol,
                out,
                jobs,
                lambda description, done, count: progress.update(
                    bar, description=description, completed=done, total=count
                ),
            )
    except KeyboardInterrupt:
        progress_console.print(f"Interrupted: finished results are in {out}, and the same command continues.")
        raise
    makers = tables(results, protocol)
    picture, written = "methods_groups.png", []
    if page is None or text is None or picture in text:
        written.append(figure(results, protocol, (out if page is None else page.parent) / picture))
    if page is not None and text is not None:
        write_whole(page, with_tables(text, makers))
        written.append(page)
    texts = {name: make() for name, make in makers.items()}
    data = {
        "results": [result._asdict() for result in results],
        "predictions": [prediction._asdict() for prediction in PREDICTIONS],
        "files": [str(path) for path in written],
    }
    emit(
        [*(f"{name}\n\n{content}" for name, content in texts.items()), *[f"wrote {path}" for path in written]],
        data,
        json,
    )


POLICIES_FOLDER = Path("out") / "comparison"

app = typer.Typer(cls=Group, help="Long comparisons.", no_args_is_help=True)


@app.callback()
def _callback() -> None:
    pass


app.command("recordings", cls=Command)(recordings)
app.command("users", cls=Command)(users)
app.command("methods", cls=Command)(methods)


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
    ] = POLICIES_FOLDER,
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
