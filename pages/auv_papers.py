"""Make the tables and the picture of the section on papers in docs/auv.md.

    python -m pages.auv_papers [FOLDER]

The results are those of `thruster reproduce ngatini2019` and `ngatini2017`; some minutes on two cores. Seconds of
a run are those of the machine, all else repeats.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import cache
from pathlib import Path

import numpy as np

from pages.page import make_page
from thruster_env.core.text_tables import markdown_table
from tuning.experiments import ngatini2017, ngatini2019
from tuning.experiments.vehicle.estimators import MEASUREMENTS
from tuning.experiments.vehicle.experiment import PathResult, Scores, position_ratio, run_tasks, tasks_of
from tuning.experiments.vehicle.figure import path_runs, paths_figure
from tuning.experiments.vehicle.models import POSE, PrintedRow
from tuning.experiments.vehicle.statements import ENKF, FKF, digits, findings, statements, with_interval

RUNS = {"ngatini2019": 50, "ngatini2017": 10}


@cache
def results(paper: str) -> list[PathResult]:
    """What `thruster reproduce` runs."""
    return run_tasks(tasks_of(paper), runs=RUNS[paper])


def members() -> str:
    """Table III beside ours."""
    (iv,) = results("ngatini2019")
    labels = [MEASUREMENTS, "EKF8", *(f"EnKF8 N={count}" for count in ngatini2019.TABLE_III)]
    rows = []
    for label in labels:
        scores, printed = iv.scores[label], _printed("ngatini2019", "IV", label)
        rows.append(
            [
                label,
                _row(printed.rmse[name] for name in POSE) if printed else "",
                _row(scores.rmse("planar")),
                _row(scores.rmse("full")),
                with_interval(scores.nees_interval),
                f"{printed.seconds:g}" if printed else "",
            ]
        )
    rows.append(["bound", "", "", _row(iv.bound.pose), "", ""])
    return markdown_table(["", "published", "by yaw alone", "full", "NEES", "s, published"], rows)


def velocities() -> str:
    """RMSE of velocities and attitude on path IV."""
    return _velocities(results("ngatini2019")[0])


def other_world() -> str:
    """The same without restoring moments, with pose."""
    (other,) = [result for result in results("ngatini2017") if result.world != "vehicle"]
    return _velocities(other, "EKF6 level")


def paths() -> str:
    """Every printed row of the five paths beside ours."""
    entries, rows = findings("ngatini2017", results("ngatini2017")), []
    for entry in entries:
        if entry.label not in (MEASUREMENTS, "EKF8", ENKF, FKF):
            continue
        names = list(ngatini2017.PATHS[entry.path].enkf.rmse)
        indices = [POSE.index(name) for name in names]
        errors = [_row(entry.scores.rmse(field)[indices]) for field in ("planar", "planar_both", "full")]
        printed = entry.printed
        rows.append(
            [
                f"{entry.path} ({', '.join(names)})",
                entry.label,
                _row(printed.rmse.values()) if printed else "",
                *errors,
                f"{printed.seconds:.3g}" if printed else "",
                entry.why,
            ]
        )
    columns = ["path", "", "published", "by yaw alone", "both by yaw alone", "full", "s, published"]
    return markdown_table([*columns, "why they differ"], rows)


def ends() -> str:
    """Errors at the end in percent."""
    rows = []
    for result in _of_vehicle():
        for label, printed in zip((ENKF, FKF), ngatini2017.PATHS[result.path][:2], strict=True):
            names = list(printed.final_percent)
            columns = [POSE.index(name) for name in names]
            ours = [
                _row(
                    100
                    * getattr(result.scores[label], field)[:, columns].mean(axis=0)
                    / np.abs(result.end[columns])
                )
                for field in ("planar_end", "full_end")
            ]
            rows.append(
                [f"{result.path} ({', '.join(names)})", label, _row(printed.final_percent.values()), *ours]
            )
    return markdown_table(["path", "", "published", "by yaw alone", "full"], rows)


def outside() -> str:
    """Time outside the bounds of the fuzzy filter."""
    rows = [[result.path, *(f"{100 * share:.0f}" for share in result.outside)] for result in _of_vehicle()]
    return markdown_table(["path", *"uvwpqr", "any"], rows)


def paper_sentences() -> str:
    """Lists of statements on the results of both papers."""
    blocks = []
    for paper in RUNS:
        lines = "\n".join(f"- {sentence}" for sentence in statements(paper, results(paper)))
        blocks.append(f"{paper}:\n\n{lines}")
    return "\n" + "\n\n".join(blocks)


def _velocities(result: PathResult, base: str = "") -> str:
    rows = []
    for label, scores in result.scores.items():
        errors = np.concatenate([scores.rmse("velocities"), scores.rmse("attitude")])
        last = [with_interval(scores.nees_interval)]
        if base:
            last.append(_ratio(scores, result.scores[base]))
        rows.append([label, *(digits(1e3 * value) for value in errors), *last])
    bound = np.concatenate([result.bound.velocities, result.bound.attitude])
    rows.append(["bound", *(digits(1e3 * value) for value in bound), *([""] * (2 if base else 1))])
    columns = ["", "u", "v", "w", "p", "q", "r", "phi", "theta", "NEES"]
    return markdown_table([*columns, f"position over {base}"] if base else columns, rows)


def _ratio(scores: Scores, base: Scores) -> str:
    return (
        ""
        if scores is base or np.isnan(scores.full).any()
        else with_interval(position_ratio(scores, base, "full"))
    )


def _of_vehicle() -> list[PathResult]:
    return [result for result in results("ngatini2017") if result.world == "vehicle"]


def _printed(paper: str, path: str, label: str) -> PrintedRow | None:
    return next(
        entry.printed for entry in findings(paper, results(paper)) if (entry.path, entry.label) == (path, label)
    )


def _row(values: Iterable[float]) -> str:
    return ", ".join(digits(value) for value in values if not np.isnan(value))


def picture(path: Path) -> Path:
    """One run of each path."""
    return paths_figure(path, path_runs("ngatini2017"))


FIGURES = {"auv_papers.png": picture}
TABLES = {
    "papers_members": members,
    "papers_velocities": velocities,
    "papers_paths": paths,
    "papers_ends": ends,
    "papers_outside": outside,
    "papers_world": other_world,
    "papers_said": paper_sentences,
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Draw the picture and write the tables."""
    make_page("auv", "pages.auv_papers", FIGURES, TABLES, __doc__.partition("\n")[0], arguments)


if __name__ == "__main__":
    main()
