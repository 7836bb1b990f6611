"""The papers on the underwater vehicle on the terminal: their tables beside ours, and conclusions."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from rich.console import RenderableType
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table
from rich.text import Text

from filters.consistency.intervals import Interval, mean_interval
from thruster_env.core.text_tables import table
from tuning.cli.benchmark import fitted, list_of
from tuning.cli.output import announce_compilation, progress_console
from tuning.experiments.vehicle.estimators import MEASUREMENTS
from tuning.experiments.vehicle.experiment import (
    PAPERS,
    PATHS,
    PathResult,
    Scores,
    path_runs,
    paths_figure,
    position_ratio,
    run_tasks,
    tasks_of,
)
from tuning.experiments.vehicle.papers import PARTICULARS, POSE, PRINTED_PATHS, RUNS, PrintedRow
from tuning.experiments.vehicle.tables import ENKF, FKF, Finding, digits, findings, statements, with_interval

# Tables of the papers on the underwater vehicle.


WHY = "why they differ"
POSES = "In each cell x, y, z [m] and psi [rad], one below the other."
FIELDS = {"planar": "by yaw alone", "planar_both": "both by yaw", "full": "full"}


def particulars_table() -> Table:
    """Table I, beside the values of our vehicle."""
    ours = {"mass": "15", "length": "0.98", "beam": "0.188", "speed": "1.94 (1 m/s) at 2.85 N"}
    rows = [
        [f"{name} [{unit}]", f"{value:g}", ours.get(name, "not in the equations")]
        for name, (value, unit) in PARTICULARS.items()
    ]
    return table("ngatini2019, table I: the vehicle", ["", "published", "ours"], rows, words=True)


def published_table(paper: str, result: PathResult, findings: list[Finding]) -> Table:
    """The printed RMSE of one path beside ours by each transformation."""
    rows = []
    for finding in findings:
        if finding.printed is None and finding.label not in ("EKF8", MEASUREMENTS):
            continue  # the tables below have it
        printed = "" if finding.printed is None else _printed_pose(finding.printed)
        seconds = "" if finding.printed is None else f"{finding.printed.seconds:.3g}"
        ours = [_pose(finding.scores, field) for field in FIELDS]
        spent = digits(finding.scores.seconds.mean()) if finding.scores.seconds.any() else ""
        rows.append(
            [
                finding.label.replace(", ", ",\n").replace(" N", "\nN"),
                printed,
                *ours,
                f"{seconds}\n{spent}".strip("\n"),
                finding.why,
            ]
        )
    bound = "\n".join(digits(value) for value in result.bound.pose)
    rows.append(["bound", "", "", "", bound, "", ""])
    columns = ["filter", "published", *FIELDS.values(), "s", WHY]
    caption = (
        f"{POSES} By yaw alone: the papers' transformation, against the true path. Both by yaw: against the "
        "path that true velocities give by yaw alone. Full: with roll and pitch. s: seconds of a run, "
        'published above ours, of one core. "Similar" means within a factor of 3.'
    )
    title = f"{paper}, path {_name(result)}: published RMSE against ours"
    return fitted(table(title, columns, rows, caption=caption), rows, flexible=WHY)


def velocity_table(result: PathResult) -> Table:
    """Each filter's errors of velocities and attitude, and whether its covariance is right."""
    rows = []
    for label, scores in result.scores.items():
        errors = np.concatenate([scores.rmse("velocities"), scores.rmse("attitude")])
        rows.append([label, *(digits(1e3 * value) for value in errors), digits(scores.nees_interval.value)])
    bound = np.concatenate([result.bound.velocities, result.bound.attitude])
    rows.append(["bound", *(digits(1e3 * value) for value in bound), ""])
    columns = ["filter", "u", "v", "w", "p", "q", "r", "phi", "theta", "NEES"]
    caption = (
        "In mm/s, mrad/s and mrad, from 2 s on. The expected NEES is the number of states. Bound: Riccati "
        "along the noise-free path."
    )
    return table(f"path {_name(result)}: RMSE of velocities and attitude", columns, rows, caption=caption)


def position_table(result: PathResult) -> Table:
    """RMSE of position with intervals, and over that of the EKF on the same runs."""
    scores, base, rows = result.scores, result.scores["EKF8"], []
    for label, errors in scores.items():
        cells = [label]
        for field in ("planar", "full"):
            if np.isnan(getattr(errors, field)).any():
                cells += ["", ""]
                continue
            interval = Interval(*(math.sqrt(v) for v in _mean_square(errors, field)))
            ratio = "" if errors is base else with_interval(position_ratio(errors, base, field))
            cells += [text.replace(" [", "\n[") for text in (with_interval(interval), ratio)]
        rows.append(cells)
    columns = ["filter", "by yaw alone [m]", "over EKF8", "full [m]", "over EKF8"]
    caption = "Root of the mean square distance over a run, 95 % intervals; ratios are paired by run."
    return fitted(table(f"path {_name(result)}: position", columns, rows, caption=caption), rows)


def end_table(results: list[PathResult]) -> Table:
    """The errors at the end in percent of the path's end."""
    rows = []
    for result in results:
        if result.world != "vehicle":
            continue
        for label, printed in zip((ENKF, FKF), PRINTED_PATHS[result.path][:2], strict=True):
            names = list(printed.final_percent)
            indices = [("x", "y", "z", "angle").index("angle" if name == "psi" else name) for name in names]
            ends, scores = np.abs(result.end[indices]), result.scores[label]
            ours = [
                "\n".join(digits(100 * value) for value in getattr(scores, field)[:, indices].mean(axis=0) / ends)
                for field in ("planar_end", "full_end")
            ]
            published = "\n".join(f"{value:g}" for value in printed.final_percent.values())
            rows.append([result.path, label, "\n".join(names), published, *ours])
    columns = ["path", "filter", "", "published", "by yaw alone", "full"]
    caption = (
        "Ours: mean distance at the end over the end value of the path without noise; published without a "
        "definition. Near zero end values the percentage is meaningless."
    )
    title = "ngatini2017: error at the end in percent"
    return fitted(table(title, columns, rows, caption=caption), rows)


def outside_table(results: list[PathResult]) -> Table:
    """The time that each velocity is outside the fuzzy filter's bounds."""
    rows = [
        [result.path, *(f"{100 * share:.0f}" for share in result.outside)]
        for result in results
        if result.world == "vehicle"
    ]
    title = "Time outside the fuzzy filter's bounds 0..1 [%], without noise"
    return table(title, ["path", *"uvwpqr", "any"], rows)


def plain_result(paper: str, result: PathResult, findings: list[Finding]) -> dict:
    """One path as plain data."""
    here = {
        finding.label: finding for finding in findings if finding.path == result.path and result.world == "vehicle"
    }
    filters = {}
    for label, scores in result.scores.items():
        printed = here[label].printed if label in here else None
        filters[label] = {
            "rmse": {
                field: [interval._asdict() for interval in scores.intervals(field)]
                for field in ("velocities", "attitude", "full", "planar", "planar_both")
            },
            "nees": scores.nees_interval._asdict(),
            "divergences": float(scores.divergences.sum()),
            "seconds": float(scores.seconds.mean()),
            "published": None if printed is None else printed._asdict(),
            "why": here[label].why if label in here else "",
        }
    return {
        "path": result.path,
        "world": result.world,
        "steps": result.steps,
        "end": result.end,
        "rmse_of_yaw_alone": result.planar_gap,
        "share_outside_bounds": result.outside,
        "bound": result.bound._asdict(),
        "filters": filters,
    }


def _mean_square(scores: Scores, field: str) -> Interval:
    return mean_interval(getattr(scores, field)[:, :3].sum(axis=1))


def _name(result: PathResult) -> str:
    meaning = PATHS[result.path].meaning
    name = result.path if result.path == meaning else f"{result.path} ({meaning})"
    return name if result.world == "vehicle" else f"{name}, {result.world}"


def _pose(scores: Scores, field: str) -> str:
    values = scores.rmse(field)
    return "" if np.isnan(values).any() else "\n".join(digits(value) for value in values)


def _printed_pose(row: PrintedRow) -> str:
    return "\n".join(f"{row.rmse[name]:g}" if name in row.rmse else "-" for name in POSE)


def reproduce_vehicle(
    paper: str, runs: int = RUNS, seed: int = 0, steps: int | None = None, series: Path | None = None
) -> tuple[list[RenderableType], dict]:
    """Run a paper's filters on its paths; return what to show, as a list and as plain data."""
    results = _run(paper, runs, seed, steps)
    compared, conclusions = findings(paper, results), statements(paper, results)
    output: list[RenderableType] = [] if paper == "ngatini2017" else [particulars_table(), Text()]
    for result in results:
        here = [finding for finding in compared if finding.path == result.path and result.world == "vehicle"]
        if here:
            output += [published_table(paper, result, here), Text()]
        output += [velocity_table(result), Text(), position_table(result), Text()]
    if paper == "ngatini2017":
        output += [end_table(results), Text(), outside_table(results), Text()]
    source = PAPERS[paper].source
    output += [Text("Conclusions from the runs"), list_of(conclusions), Text(), Text(f"{paper}: {source}")]
    output.append(list_of(PAPERS[paper].remarks))
    data = {
        "settings": {"runs": runs, "seed": seed, "steps": steps},
        "source": source,
        "results": [plain_result(paper, result, compared) for result in results],
        "statements": conclusions,
        "remarks": list(PAPERS[paper].remarks),
    }
    if series is not None:
        drawn = path_runs(paper, seed=seed, steps=steps)
        output += [Text(), Text(f"Picture: {paths_figure(series, drawn)}")]
        data |= {"series": [run._asdict() for run in drawn], "picture": str(series)}
    return output, data


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
