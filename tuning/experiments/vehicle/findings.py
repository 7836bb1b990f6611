"""Printed values beside ours, and why they differ."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tuning.experiments import ngatini2017, ngatini2019
from tuning.experiments.vehicle.experiment import PathResult
from tuning.experiments.vehicle.printed import POSE, PrintedRow
from tuning.experiments.vehicle.scores import Scores

FACTOR = 3.0  # up to which two errors are of the same size: path and duration are not printed
FIELDS = {
    "full": "similar to ours by the full transformation",
    "planar_both": "similar to ours with path and estimate both by yaw alone",
    "planar": "similar to ours by yaw alone, an error that no filter can correct",
}
ENKF, FKF = "EnKF8 N=50", "fuzzy 0..1"  # our counterparts of the printed filters


class Finding(NamedTuple):
    """One filter on one path: the printed values, if there are any, and ours."""

    path: str
    label: str
    printed: PrintedRow | None
    scores: Scores
    why: str


def findings(paper: str, results: list[PathResult]) -> list[Finding]:
    """All filters on the papers' paths, in the order that they ran in; not those of another world."""
    found = []
    for result in results:
        if result.world == "vehicle":
            for label, scores in result.scores.items():
                printed = printed_row(paper, result.path, label)
                why = "" if printed is None else why_different(printed, scores, result)
                found.append(Finding(result.path, label, printed, scores, why))
    return found


def printed_row(paper: str, path: str, label: str) -> PrintedRow | None:
    """The printed row of one of our filters."""
    if paper == ngatini2019.PAPER.name:
        rows = {f"EnKF8 N={count}": row for count, row in ngatini2019.TABLE_III.items()}
        return rows.get(label) if path == "IV" else None
    return {ENKF: ngatini2017.PATHS[path].enkf, FKF: ngatini2017.PATHS[path].fkf}.get(label)


def why_different(printed: PrintedRow, scores: Scores, result: PathResult) -> str:
    """Which of our errors the printed ones resemble, and which are smaller than these measurements allow."""
    said = []
    for field, words in FIELDS.items():
        ratios = [value / one for value, one in _pairs(printed, scores.rmse(field))]
        if all(1 / FACTOR < ratio < FACTOR for ratio in ratios):
            said = [words]
            break
    if not said:
        said = [f"{name} {words}" for name, words in _by_component(printed, scores).items()]
        said += ["no one transformation gives the row"] * (len(said) > 1)
    below = [name for name, value in printed.rmse.items() if value < result.bound.pose[POSE.index(name)] / FACTOR]
    if below:
        said.append(f"{', '.join(below)} below the limit set by measured u, v, w, r on a true path")
    return "; ".join(said)


def _pairs(printed: PrintedRow, rmse: np.ndarray) -> list[tuple[float, float]]:
    return [(value, rmse[POSE.index(name)]) for name, value in printed.rmse.items()]


def _by_component(printed: PrintedRow, scores: Scores) -> dict[str, str]:
    """For each reason the components that it would explain, by the names of these."""
    found: dict[str, list[str]] = {}
    for name, value in printed.rmse.items():
        for field, words in FIELDS.items():
            if 1 / FACTOR < value / scores.rmse(field)[POSE.index(name)] < FACTOR:
                found.setdefault(words, []).append(name)
                break
        else:
            found.setdefault("unlike any of ours", []).append(name)
    return {", ".join(names): words for words, names in found.items()}
