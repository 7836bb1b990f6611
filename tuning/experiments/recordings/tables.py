"""Tables of docs/real_data.md and of `thruster study recordings`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from thruster_env.core.files import as_toml, write_whole
from thruster_env.core.text_tables import markdown_table
from tuning.experiments.recordings.identification import (
    CHOSEN,
    OURS,
    STRUCTURES,
    Task,
    estimates_of,
    identify_all,
    ratios,
    regimes,
    rmse,
    settled_rmse,
    structure_ratios,
)
from tuning.experiments.recordings.model import IDENTIFIED, Recording, model, read_recordings

RESULTS = Path("out") / "recordings.json"
MEAN = "mean"
RATIO_HEADER = ["run", "own, N", "ours, N", "ratio", "best clocks", "raw rows"]
CLOCK_HEADER = ["run", "offset, s", "first half", "second half"]
LADDER_HEADER = ["model", "ratio, worst", "ratio, mean", "raw rows, worst", "log-likelihood"]
NUMBER_HEADER = ["constant", "value", "standard error", "without one run", "unit"]

Estimates = Mapping[str, Sequence[np.ndarray]]


class Table(NamedTuple):
    """A header and rows of cells."""

    header: list[str]
    rows: list[list[str]]


def tables_of(
    runs: Sequence[Recording], estimates: Estimates, tasks: Mapping[str, Mapping] | None = None
) -> dict[str, Table]:
    """All tables by name, in their order; those of structures and parameters where these were identified again."""
    tables = {
        "ratios": Table(RATIO_HEADER, ratio_rows(runs, estimates)),
        "estimators": Table(["run", *estimates], baseline_rows(runs, estimates)),
        "clocks": Table(CLOCK_HEADER, clock_rows(runs)),
    }
    if tasks is not None:
        tables["structures"] = Table(LADDER_HEADER, ladder_rows(runs, tasks))
        tables["numbers"] = Table(NUMBER_HEADER, number_rows(runs, tasks))
    return tables


def ratio_rows(runs: Sequence[Recording], estimates: Estimates) -> list[list[str]]:
    """Our error over that of the recorder's own, on each run and on average."""
    all_ratios = [ratios(estimate, run) for estimate, run in zip(estimates[OURS], runs, strict=True)]
    rows = []
    for run, of_run, ours in zip(runs, all_ratios, estimates[OURS], strict=True):
        mark = " (desired)" if run.own_is_desired else ""
        own_rmse = f"{rmse(run.own, run):.2f}{mark}"
        rows.append([run.name, own_rmse, f"{rmse(ours, run):.2f}", *(f"{value:.2f}" for value in of_run)])
    return [*rows, [MEAN, "", "", *(f"{value:.2f}" for value in np.mean(all_ratios, axis=0))]]


def baseline_rows(runs: Sequence[Recording], estimates: Estimates) -> list[list[str]]:
    """RMSE of every estimator over 0.2 s on each run: all rows, then settled ones [N]."""
    rows = []
    for i, run in enumerate(runs):
        cells = [
            f"{rmse(estimate[i], run):.2f}/{settled_rmse(estimate[i], run):.2f}" for estimate in estimates.values()
        ]
        rows.append([run.name, *cells])
    return rows


def clock_rows(runs: Sequence[Recording]) -> list[list[str]]:
    """The offset of the load cell's clock on each run."""
    return [[run.name, *(f"{value + 0.0:+.3f}" for value in (run.offset, *run.halves))] for run in runs]


def ladder_rows(runs: Sequence[Recording], tasks: Mapping[str, Mapping]) -> list[list[str]]:
    """The errors of each structure, on runs left out of the identification."""
    rows = []
    for name, structure in STRUCTURES.items():
        errors = np.array(structure_ratios(name, runs, tasks))
        cells = errors[:, 0].max(), errors[:, 0].mean(), errors[:, 2].max()
        likelihood = tasks[Task(name).name]["log_likelihood"]
        rows.append([structure.about, *(f"{value:.2f}" for value in cells), f"{likelihood:.0f}"])
    return rows


def number_rows(runs: Sequence[Recording], tasks: Mapping[str, Mapping]) -> list[list[str]]:
    """The chosen parameters, their standard errors, and their range when one run is left out."""
    with_all, rows = tasks[Task(CHOSEN).name], []
    for parameter in STRUCTURES[CHOSEN].free:
        value, error = with_all["values"][parameter.name], with_all["standard_errors"][parameter.name]
        left_out = [tasks[Task(CHOSEN, run.name).name]["values"][parameter.name] for run in runs]
        name = parameter.name if with_all["determined"][parameter.name] else f"{parameter.name} (not determined)"
        rows.append(
            [name, f"{value:.4g}", f"{error:.2g}", f"{min(left_out):.4g} to {max(left_out):.4g}", parameter.unit]
        )
    return rows


def sentences(estimates: Estimates, runs: Sequence[Recording]) -> list[str]:
    """The table of ratios in one sentence."""
    all_ratios = np.array([ratios(estimate, run) for estimate, run in zip(estimates[OURS], runs, strict=True)])
    averaged, best, raw = all_ratios.T
    return [
        f"Averaged over 0.2 s the error of the estimated thrust is on average {averaged.mean():.2f} times that of "
        f"the recorder's own, at most {averaged.max():.2f}; with the best clocks at most {best.max():.2f}; "
        f"on raw rows {raw.min():.2f} to {raw.max():.2f}."
    ]


def tables_from(recordings: Path, results: Path = RESULTS) -> dict[str, Callable[[], str]]:
    """The tables of docs/real_data.md by name, from a folder of recordings; the project's numbers are written.

    Identifications that are in the file of results are not done again; all take a quarter of an hour on two cores.
    """
    runs = read_recordings(recordings)
    tasks = identify_all(runs, results, progress=lambda name, done, count: print(f"{done + 1}/{count} {name}"))
    keep(tasks[Task(CHOSEN).name], [run.name for run in runs])
    left_out, on_all = estimates_of(runs, tasks), estimates_of(runs)

    def regime() -> str:
        rows = [
            [f"{row.factor:g}", f"{row.log_likelihood:.0f}", f"{row.nis:.2f}", f"{row.ratio:.3f}"]
            for row in regimes(model(), runs)
        ]
        return markdown_table(["Q times", "log-likelihood of the tachometer", "mean NIS", "ratio, mean"], rows)

    tables = {
        name: (lambda table=table: markdown_table(*table))
        for name, table in tables_of(runs, left_out, tasks).items()
    }
    ratios = tables["ratios"]
    return {
        **tables,
        "ratios": lambda: "\n\n".join([ratios(), *sentences(left_out, runs)]),
        "all_runs": lambda: markdown_table(*tables_of(runs, on_all)["ratios"]),
        "regime": regime,
    }


def keep(task: Mapping, runs: Sequence[str]) -> None:
    """Write the numbers that the project takes."""
    known = {name: task[name] for name in ("log_likelihood", "standard_errors", "determined")}
    tables = {"values": task["values"], "identified": {"logs": list(runs), **known}}
    write_whole(IDENTIFIED, as_toml(tables, "Found by `python -m docs.scripts real_data`; see docs/real_data.md."))
