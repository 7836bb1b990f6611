"""The papers' tables beside ours: for docs/appendix/auv.md and `thruster reproduce`."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from functools import cache
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np

from filters.consistency.nees import Interval, interval, resampled_means
from thruster_env.core.checks import at_least
from thruster_env.core.text_tables import Table
from thruster_env.logs.write import check_picture
from tuning.api.markers import OUTPUT, WRITTEN, Option, PythonOnly, Seed
from tuning.api.markers import RUNS as RUNS_PANEL
from tuning.api.result import Printed
from tuning.cli.output import progress_of
from tuning.experiments.vehicle_papers import (
    MEASUREMENTS,
    NGATINI2019,
    POSE,
    PRINTED_PATHS,
    RUNS,
    TABLE_III,
    PrintedRow,
)
from tuning.experiments.vehicle_runs import (
    MOST_RUNS,
    PAPERS,
    PathResult,
    Scores,
    path_runs,
    paths_figure,
    run_tasks,
    tasks_of,
)

WHY = "why they differ"
CONCLUSIONS = "docs/appendix/auv.md has the conclusions."
FACTOR = 3.0  # up to which two errors are of the same size: path and duration are not printed
FIELDS = {
    "full": "similar to ours by the full transformation",
    "planar_both": "similar to ours with path and estimate both by yaw alone",
    "planar": "similar to ours by yaw alone, an error that no filter can correct",
}
ENKF, FKF = "EnKF8 N=50", "fuzzy 0..1"  # our counterparts of the printed filters
NOT_ON_PAGE = "N=100", "N=200", "0..1 offsets"  # ends of labels
SHOWN = [0, 3, 4]  # of the velocities: u, whose errors those of v, w and r equal, and p and q
RUNS_OF = {"ngatini2019": 50, "ngatini2017": 10}


class Finding(NamedTuple):
    """One filter on one path: the printed values, if there are any, and ours."""

    path: str
    label: str
    printed: PrintedRow | None
    scores: Scores
    why: str


def findings(paper: str, results: list[PathResult]) -> list[Finding]:
    """All filters on the papers' paths, in the order that they ran in; not those of another world."""
    rows = []
    for result in results:
        if result.world == "vehicle":
            for label, scores in result.scores.items():
                printed = printed_row(paper, result.path, label)
                why = "" if printed is None else why_different(printed, scores, result)
                rows.append(Finding(result.path, label, printed, scores, why))
    return rows


def printed_row(paper: str, path: str, label: str) -> PrintedRow | None:
    """The printed row of one of our filters."""
    if paper == NGATINI2019.name:
        rows = {f"EnKF8 N={count}": row for count, row in TABLE_III.items()}
        return rows.get(label) if path == "IV" else None
    return {ENKF: PRINTED_PATHS[path].enkf, FKF: PRINTED_PATHS[path].fkf}.get(label)


def why_different(printed: PrintedRow, scores: Scores, result: PathResult) -> str:
    """Which of our errors the printed ones resemble, and which are smaller than these measurements allow."""
    reasons = []
    for field, words in FIELDS.items():
        ratios = [value / error for value, error in _pairs(printed, scores.rmse(field))]
        if all(1 / FACTOR < ratio < FACTOR for ratio in ratios):
            reasons = [words]
            break
    if not reasons:
        reasons = [f"{name} {words}" for name, words in _by_component(printed, scores).items()]
        reasons += ["no one transformation gives the row"] * (len(reasons) > 1)
    below = [name for name, value in printed.rmse.items() if value < result.bound.pose[POSE.index(name)] / FACTOR]
    if below:
        reasons.append(f"{', '.join(below)} below the limit set by measured u, v, w, r on a true path")
    return "; ".join(reasons)


def _pairs(printed: PrintedRow, rmse: np.ndarray) -> list[tuple[float, float]]:
    return [(value, rmse[POSE.index(name)]) for name, value in printed.rmse.items()]


def _by_component(printed: PrintedRow, scores: Scores) -> dict[str, str]:
    """For each reason the components that it would explain, by the names of these."""
    components: dict[str, list[str]] = {}
    for name, value in printed.rmse.items():
        for field, words in FIELDS.items():
            if 1 / FACTOR < value / scores.rmse(field)[POSE.index(name)] < FACTOR:
                components.setdefault(words, []).append(name)
                break
        else:
            components.setdefault("unlike any of ours", []).append(name)
    return {", ".join(names): words for words, names in components.items()}


def digits(value: float) -> str:
    """Three digits, thousands apart; nothing for NaN."""
    if math.isnan(value):
        return ""
    rounded = float(f"{value:.3g}")
    return f"{rounded:,.0f}".replace(",", " ") if 1000 <= abs(rounded) < 1e15 else f"{rounded:g}"


def with_interval(estimate: Interval) -> str:
    """A value with its interval; nothing for NaN."""
    value, low, high = map(digits, estimate)
    return f"{value} [{low}, {high}]" if value else ""


def members(iv: PathResult) -> Table:
    """Table III beside ours."""
    labels = [MEASUREMENTS, "EKF8", *(f"EnKF8 N={count}" for count in TABLE_III)]
    rows = []
    for label in labels:
        scores, printed = iv.scores[label], printed_row("ngatini2019", "IV", label)
        theirs = _row(printed.rmse[name] for name in POSE) if printed else ""
        ours = _row(scores.rmse("planar")), _row(scores.rmse("full")), with_interval(scores.nees_interval)
        rows.append([label, theirs, *ours, f"{printed.seconds:g}" if printed else ""])
    rows.append(["bound", "", "", _row(iv.bound.pose), "", ""])
    title = "Path IV: RMSE of x, y, z [m] and psi [rad]"
    return Table(title, ["", "published", "by yaw alone", "full", "NEES", "s, published"], rows)


def paths(results: Sequence[PathResult]) -> Table:
    """Every printed row of the five paths beside ours."""
    rows = []
    for entry in findings("ngatini2017", list(results)):
        if entry.label not in (ENKF, FKF):
            continue
        names = list(PRINTED_PATHS[entry.path].enkf.rmse)
        indices = [POSE.index(name) for name in names]
        errors = [_row(entry.scores.rmse(field)[indices]) for field in ("planar", "planar_both", "full")]
        printed = entry.printed
        theirs = _row(printed.rmse.values()) if printed else ""
        seconds = f"{printed.seconds:.3g}" if printed else ""
        rows.append([f"{entry.path} ({', '.join(names)})", entry.label, theirs, *errors, seconds, entry.why])
    columns = ["path", "", "published", "by yaw alone", "both by yaw alone", "full", "s, published", WHY]
    caption = (
        "By yaw alone: the papers' transformation, against the true path. Both: against the path that true "
        f'velocities give by yaw alone. Full: with roll and pitch. "Similar" means within a factor of {FACTOR:g}.'
    )
    return Table("RMSE of the paths, m and rad", columns, rows, caption=caption, words=[WHY])


def ends(results: Sequence[PathResult]) -> Table:
    """Errors at the end in percent."""
    rows = []
    for result in _of_vehicle(results):
        for label, printed in zip((ENKF, FKF), PRINTED_PATHS[result.path][:2], strict=True):
            names = list(printed.final_percent)
            columns = [POSE.index(name) for name in names]
            fields = (getattr(result.scores[label], field)[:, columns] for field in ("planar_end", "full_end"))
            ours = [_row(100 * errors.mean(axis=0) / np.abs(result.end[columns])) for errors in fields]
            theirs = _row(printed.final_percent.values())
            rows.append([f"{result.path} ({', '.join(names)})", label, theirs, *ours])
    caption = "Near zero end values the percentage is meaningless."
    heads = ["path", "", "published", "by yaw alone", "full"]
    return Table("Mean distance at the end, in percent of the end value", heads, rows, caption=caption)


def velocities(result: PathResult, base: str = "", omitted: tuple[str, ...] = ()) -> Table:
    """RMSE of velocities and attitude on a path, and of position over that of the filter `base`."""
    rows = []
    for label, scores in result.scores.items():
        if label.endswith(omitted):
            continue
        errors = np.concatenate([scores.rmse("velocities")[SHOWN], scores.rmse("attitude")])
        last = [with_interval(scores.nees_interval)]
        if base:
            last.append(_ratio(scores, result.scores[base]))
        rows.append([label, *(digits(1e3 * value) for value in errors), *last])
    bound = np.concatenate([result.bound.velocities[SHOWN], result.bound.attitude])
    rows.append(["bound", *(digits(1e3 * value) for value in bound), *([""] * (2 if base else 1))])
    columns = ["", "u", "p", "q", "phi", "theta", "NEES"]
    world = "" if result.world == "vehicle" else f", {result.world}"
    title = f"Path {result.path}{world}: RMSE in mm/s, mrad/s and mrad from 2 s on"
    return Table(title, [*columns, f"position over {base}"] if base else columns, rows)


def position_ratio(a: Scores, b: Scores, field: str) -> Interval:
    """RMSE of position of a over that of b on the same runs, paired, of a field of poses such as "full"."""
    above, below = (getattr(scores, field)[:, :3].sum(axis=1) for scores in (a, b))
    ratios = np.sqrt(resampled_means(above) / resampled_means(below))
    return interval(float(np.sqrt(above.mean() / below.mean())), ratios, len(above), is_ratio=True)


def _ratio(scores: Scores, base: Scores) -> str:
    if scores is base or np.isnan(scores.full).any():
        return ""
    return with_interval(position_ratio(scores, base, "full"))


def _of_vehicle(results: Iterable[PathResult]) -> list[PathResult]:
    return [result for result in results if result.world == "vehicle"]


def _row(values: Iterable[float]) -> str:
    return ", ".join(digits(value) for value in values if not np.isnan(value))


def reproduce(
    name: Annotated[str, PythonOnly()],
    runs: Annotated[int, Option(RUNS_PANEL)] = RUNS,
    steps: Annotated[int | None, Option(RUNS_PANEL)] = None,
    series: Annotated[Path | None, Option(OUTPUT, metavar="FILE", file=WRITTEN)] = None,
    seed: Seed = 0,
) -> Printed:
    """Repeat a paper on the underwater vehicle many times and say why its tables differ from ours.

    The papers compare ensemble and fuzzy Kalman filters at 1 kHz by the RMSE
    of the vehicle's path. The tables add other filters and the bare measurements, on the same runs, with the
    papers' transformation and with the right one.

    Example: thruster reproduce ngatini2019 --series paths.png

    Args:
        name: the paper.
        runs: independent runs of some 25000 steps, at least 2; few make wide intervals.
        steps: first steps of 1 ms of each path, for a quick look; all by default.
        series: also draw one run of each path: .png, .svg or .pdf; into --json, too.
        seed: seed of all randomness; the same seed gives the same results.
    """
    if series is not None:
        check_picture(series, "--series")
    runs = at_least("runs", runs, 2, MOST_RUNS)
    with progress_of(f"{runs} runs") as progress:
        results = run_tasks(
            tasks_of(name),
            runs=runs,
            seed=seed,
            steps=steps,
            on_part=lambda done, total, label: progress(label, done, total),
        )
    compared = findings(name, results)
    first = [members(results[0])] if name == NGATINI2019.name else [paths(results), ends(results)]
    output: list[Any] = [*first, *(velocities(result, "EKF8") for result in results)]
    output += [f"{name}: {PAPERS[name].source}", *PAPERS[name].remarks, CONCLUSIONS]
    data = {
        "settings": {"runs": runs, "seed": seed, "steps": steps},
        "source": PAPERS[name].source,
        "results": [plain_result(result, compared) for result in results],
        "remarks": list(PAPERS[name].remarks),
    }
    if series is not None:
        drawn = path_runs(name, seed=seed, steps=steps)
        output.append(f"Picture: {paths_figure(series, drawn)}")
        data |= {"series": [run._asdict() for run in drawn], "picture": str(series)}
    return Printed(output, data)


def plain_result(result: PathResult, findings: list[Finding]) -> dict:
    """One path as plain data."""
    here = {
        finding.label: finding for finding in findings if finding.path == result.path and result.world == "vehicle"
    }
    fields = ("velocities", "attitude", "full", "planar", "planar_both")
    filters = {}
    for label, scores in result.scores.items():
        printed = here[label].printed if label in here else None
        filters[label] = {
            "rmse": {field: [interval._asdict() for interval in scores.intervals(field)] for field in fields},
            "nees": scores.nees_interval._asdict(),
            "divergences": float(scores.divergences.sum()),
            "seconds": float(scores.seconds.mean()),
            "published": None if printed is None else printed._asdict(),
            "why": here[label].why if label in here else "",
        }
    plain = result._asdict() | {"bound": result.bound._asdict(), "filters": filters}
    return {key: value for key, value in plain.items() if key != "scores"}


@cache
def results(paper: str) -> list[PathResult]:
    """What `thruster reproduce` runs."""
    return run_tasks(tasks_of(paper), runs=RUNS_OF[paper])


FIGURES = {"auv_papers.png": lambda path: paths_figure(path, path_runs("ngatini2017"))}
TABLES = {
    "papers_members": lambda: members(results("ngatini2019")[0]).on_page(),
    "papers_velocities": lambda: velocities(results("ngatini2019")[0], omitted=NOT_ON_PAGE).on_page(),
    "papers_paths": lambda: paths(results("ngatini2017")).on_page(),
    "papers_ends": lambda: ends(results("ngatini2017")).on_page(),
    "papers_world": lambda: velocities(results("ngatini2017")[-1], "EKF6 level", NOT_ON_PAGE).on_page(),
}
