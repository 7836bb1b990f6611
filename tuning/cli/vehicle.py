"""The papers on the underwater vehicle on the terminal: their tables beside ours, and conclusions."""

from __future__ import annotations

from pathlib import Path

from rich.console import RenderableType
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.text import Text

from tuning.cli.benchmark import list_of
from tuning.cli.output import announce_compilation, progress_console
from tuning.cli.vehicle_tables import (
    end_table,
    outside_table,
    particulars_table,
    plain_result,
    position_table,
    published_table,
    velocity_table,
)
from tuning.experiments.vehicle.experiment import PathResult, run_tasks
from tuning.experiments.vehicle.figure import path_runs, paths_figure
from tuning.experiments.vehicle.findings import findings
from tuning.experiments.vehicle.printed import RUNS
from tuning.experiments.vehicle.statements import statements
from tuning.experiments.vehicle.tasks import PAPERS, tasks_of


def reproduce_vehicle(
    paper: str, runs: int = RUNS, seed: int = 0, steps: int | None = None, series: Path | None = None
) -> tuple[list[RenderableType], dict]:
    """Run a paper's filters on its paths; return what to show, as a list and as plain data."""
    results = _run(paper, runs, seed, steps)
    found, said = findings(paper, results), statements(paper, results)
    shown: list[RenderableType] = [] if paper == "ngatini2017" else [particulars_table(), Text()]
    for result in results:
        here = [one for one in found if one.path == result.path and result.world == "vehicle"]
        if here:
            shown += [published_table(paper, result, here), Text()]
        shown += [velocity_table(result), Text(), position_table(result), Text()]
    if paper == "ngatini2017":
        shown += [end_table(results), Text(), outside_table(results), Text()]
    source = PAPERS[paper].source
    shown += [Text("Conclusions from the runs"), list_of(said), Text(), Text(f"{paper}: {source}")]
    shown.append(list_of(PAPERS[paper].remarks))
    data = {
        "settings": {"runs": runs, "seed": seed, "steps": steps},
        "source": source,
        "results": [plain_result(paper, result, found) for result in results],
        "statements": said,
        "remarks": list(PAPERS[paper].remarks),
    }
    if series is not None:
        drawn = path_runs(paper, seed=seed, steps=steps)
        shown += [Text(), Text(f"Picture: {paths_figure(series, drawn)}")]
        data |= {"series": [one._asdict() for one in drawn], "picture": str(series)}
    return shown, data


def _run(paper: str, runs: int, seed: int, steps: int | None) -> list[PathResult]:
    announce_compilation()
    columns = (BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TextColumn("{task.description}"))
    with Progress(*columns, console=progress_console) as progress:
        task = progress.add_task(f"{runs} runs", total=None)
        return run_tasks(
            tasks_of(paper),
            runs=runs,
            seed=seed,
            steps=steps,
            on_part=lambda done, total, label: progress.update(
                task, completed=done, total=total, description=label
            ),
        )
