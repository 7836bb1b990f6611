"""`thruster study methods`: all methods of tuning on the same filters, data and budgets."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from tuning.cli.options import OUTPUT, RUNS, JsonOption
from tuning.cli.output import announce_compilation, emit, progress_console

RESULTS = Path("out") / "methods"


def command(
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
    ] = RESULTS,
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
    written = [figure(results, protocol, (out if page is None else page.parent) / "methods_groups.png")]
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
