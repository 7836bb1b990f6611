"""`thruster study`: long comparisons of problems of users, recordings, methods of tuning, and policies."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
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
from thruster_env.core.text_tables import Table
from tuning.api.markers import INPUT, OUTPUT, RUNS, Option
from tuning.api.result import Printed
from tuning.cli.app import Command, Group
from tuning.cli.output import progress_console
from tuning.cli.verbs import command_of

USERS_FOLDER = Path("out") / "users"


@contextmanager
def progress_of(title: str, out: Path) -> Iterator[Callable[[str, int, int], None]]:
    """A bar of long work: the callback takes what is running, how much is done, and how much there is."""
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    try:
        with Progress(*columns, console=progress_console) as progress:
            bar = progress.add_task(title, total=None)
            yield lambda text, done, count: progress.update(bar, description=text, completed=done, total=count)
    except KeyboardInterrupt:
        progress_console.print(f"Interrupted: finished work is in {out}, and the same command continues.")
        raise


def users(
    problem: Annotated[Sequence[str], Option(INPUT, metavar="MODULE:OBJECT")] = (),
    filters: Annotated[Sequence[str], Option(RUNS, ("--filter",))] = (),
    trials: Annotated[int | None, Option(RUNS, least=1, most=1_000_000)] = None,
    seed: Annotated[int, Option(RUNS, least=0, most=2**31 - 1)] = 0,
    quick: Annotated[bool, Option(RUNS)] = False,
    out: Annotated[Path, Option(OUTPUT)] = USERS_FOLDER,
) -> Printed:
    """Tune filters on users' problems, and compare each with its user's baselines.

    The table has the held-out score of the tuned filter over that of each baseline, with 95 % intervals paired by
    run; "!" marks significantly worse ones, by Holm's procedure at 5 % over the whole table. Ctrl-C keeps
    finished cases, and the same command continues. All cases take about an hour on one core.

    Example: thruster study users --quick

    Args:
        problem: a problem, may be repeated; by default the twelve of tests/users in a checkout of the project.
        filters: a filter, may be repeated; by default ekf, ukf, enkf, ekf-robust.
        trials: trials of each study; 50.
        seed: seed of all studies.
        quick: two problems, one filter, four trials: a test run without meaningful results.
        out: folder of results; existing ones are not recomputed. Use another one after changes in the code.
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
    with progress_of("tuning", out) as progress:
        cases = run_panel(panel, out, progress)
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
    return Printed([Table(title, heads, rows), *conclusions, *[f"wrote {file}" for file in files]], data)


RECORDINGS_FILE = Path("out") / "recordings.json"


def recordings(
    data: Annotated[Path, Option(INPUT)],
    identify: Annotated[bool, Option(RUNS)] = False,
    out: Annotated[Path, Option(OUTPUT)] = RECORDINGS_FILE,
) -> Printed:
    """Compare estimates of a recorded thruster's thrust with its load cell, and with the recorder's own estimate.

    The filter sees command and tachometer. By default its parameters are the project's, identified from six runs;
    with --identify, each run is estimated with parameters identified without that run. The recordings are those of
    J. A. Boehm (University of Maryland, 2019), which are not part of this project: see docs/real_data.md.

    Example: thruster study recordings --data rov_thruster

    Args:
        data: folder with the recorded runs as .csv files, or with a folder closed_loop_25Hz.
        identify: identify all parameters again, of nine structures, with and without each run: a quarter of an
            hour.
        out: with --identify: file of results; existing ones are not recomputed.
    """
    from tuning.experiments.recordings.identification import estimates_of, identify_all, sentences, tables_of
    from tuning.experiments.recordings.model import read_recordings

    runs = read_recordings(data)
    if identify:
        check_target(out)
    tasks = None
    if identify:
        with progress_of("identifying", out) as progress:
            tasks = identify_all(runs, out, progress=progress)
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
    output = [Table(titles[name], *content) for name, content in tables.items()]
    named = {
        name: [dict(zip(content.header, row, strict=True)) for row in content.rows]
        for name, content in tables.items()
    }
    answers = sentences(estimates, runs)
    return Printed([*output, *answers], {**named, "answers": answers})


METHODS_FOLDER = Path("out") / "methods"


def methods(
    groups: Annotated[str, Option(RUNS)] = "ABCDEFGH",
    method: Annotated[Sequence[str], Option(RUNS)] = (),
    sets: Annotated[int | None, Option(RUNS, least=2, most=20)] = None,
    runs: Annotated[float | None, Option(RUNS, least=100, most=1e7)] = None,
    seconds: Annotated[float | None, Option(RUNS, least=0.1, most=1e4)] = None,
    many: Annotated[int | None, Option(RUNS, least=10, most=10**5)] = None,
    starts: Annotated[int | None, Option(RUNS, least=1, most=100)] = None,
    jobs: Annotated[int, Option(RUNS, least=1, most=1000)] = 1,
    quick: Annotated[bool, Option(RUNS)] = False,
    out: Annotated[Path, Option(OUTPUT)] = METHODS_FOLDER,
    page: Annotated[Path | None, Option(OUTPUT, metavar="FILE.md")] = None,
) -> Printed:
    """Run every method of tuning on the same data within the same budget, and score it on held-out truth.

    The regret of a method is its score over that of the best constant parameters, found by gradients from many
    starts on many runs. Ctrl-C keeps finished results, and the same command continues. The whole study takes days;
    the options reduce it, and results of different budgets are stored separately.

    Example: thruster study methods --quick

    Args:
        groups: groups of problems.
        method: a method, may be repeated; by default all.
        sets: data sets; 20.
        runs: passes that a method may take; 1e5.
        seconds: seconds of one core; 100.
        many: runs of the reference; 2000.
        starts: starts of the reference; 20.
        jobs: processes.
        quick: a test run without meaningful results.
        out: folder of results, which several hosts may share; existing ones are not recomputed.
        page: page whose tables are rewritten, with the picture beside it.
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
    with progress_of("methods", out) as progress:
        results = run_protocol(protocol, out, jobs, progress)
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
    parts = [*(f"{name}\n\n{content}" for name, content in texts.items()), *[f"wrote {path}" for path in written]]
    return Printed(parts, data)


POLICIES_FOLDER = Path("out") / "comparison"


def policies(
    quick: Annotated[bool, Option(RUNS)] = False,
    seeds: Annotated[int | None, Option(RUNS, least=1, most=1000)] = None,
    steps: Annotated[int | None, Option(RUNS, least=1, most=10**12)] = None,
    recurrent: Annotated[bool, Option(RUNS)] = False,
    jobs: Annotated[int | None, Option(RUNS, least=1, most=1000)] = None,
    out: Annotated[Path, Option(OUTPUT)] = POLICIES_FOLDER,
    page: Annotated[Path | None, Option(OUTPUT, metavar="FILE.md")] = None,
) -> Printed:
    """Train policies on raw, filtered and true state, and compare them with model-predictive control, PI and LQG.

    It trains PPO at three noise levels of the thrust sensor, SAC, and policies that correct the controller, scores
    all on the same held-out episodes, and writes a page with tables and two pictures. Ctrl-C keeps finished work,
    and the same command continues. On two cores it takes an hour or more.

    Example: thruster study policies --quick

    Args:
        quick: one noise, two seeds, few steps: a test run without meaningful results.
        seeds: training seeds of each learned policy; 5 by default.
        steps: training steps of each policy; by default those of `thruster train`.
        recurrent: also PPO with an LSTM on raw measurements: many hours.
        jobs: number of processes; as many as cores.
        out: folder of results; existing ones are not recomputed.
        page: page whose tables are rewritten, with the pictures beside it.
    """
    from tuning.policies.algorithms import check_installed

    check_installed()
    from tuning.experiments.policies import QUICK, Comparison, run_comparison
    from tuning.experiments.policies_report import (
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
    with progress_of("policies", out) as progress:
        results = run_comparison(comparison, out, jobs, lambda run, *counts: progress(run.name, *counts))
    written = write_report(results, comparison, target, rough=quick)
    rows = {noise: rows_of(results, noise) for noise in comparison.noises}
    conclusions, files = answers(results), [str(path) for path in written]
    summary = summary_rows(results)
    tables = [Table(f"{noise} noise; thrust errors in N", HEADER, rows[noise]) for noise in rows]
    data = {
        "policies": {noise: [dict(zip(HEADER, row, strict=True)) for row in rows[noise]] for noise in rows},
        "summary": summary,
        "answers": conclusions,
        "files": files,
    }
    tables.append(Table("in short, with 95 % intervals", ["", *comparison.noises], summary))
    return Printed([*tables, *conclusions, *[f"wrote {path}" for path in files]], data)


app = typer.Typer(cls=Group, help="Long comparisons.", no_args_is_help=True)


@app.callback()
def _callback() -> None:
    pass


for function in (recordings, users, methods, policies):
    app.command(function.__name__, cls=Command)(command_of(function))
