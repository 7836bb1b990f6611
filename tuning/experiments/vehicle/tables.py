"""The papers' tables beside ours, and sentences on them: for docs/appendix/auv.md and `thruster reproduce`."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from functools import cache
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np

from filters import FuzzyKalmanFilter
from filters.consistency.nees import Interval
from thruster_env.auv.parameters import SEGOROGENI, mass_matrix
from thruster_env.core.checks import at_least
from thruster_env.core.text_tables import Table, markdown_table
from thruster_env.logs.write import check_picture
from tuning.api.markers import OUTPUT, WRITTEN, Option, PythonOnly, Seed
from tuning.api.markers import RUNS as RUNS_PANEL
from tuning.api.result import Printed
from tuning.cli.output import progress_of
from tuning.experiments.vehicle.estimators import MEASUREMENTS, level_model
from tuning.experiments.vehicle.experiment import (
    MEASURED_PLACES,
    MOST_RUNS,
    PAPERS,
    PathResult,
    Scores,
    path_runs,
    paths_figure,
    position_ratio,
    run_tasks,
    tasks_of,
)
from tuning.experiments.vehicle.papers import (
    DT,
    FUZZY_HIGH,
    FUZZY_LOW,
    NGATINI2019,
    NOISE,
    POSE,
    PRINTED_PATHS,
    RUNS,
    TABLE_III,
    PrintedRow,
)

WHY = "why they differ"
FACTOR = 3.0  # up to which two errors are of the same size: path and duration are not printed
FIELDS = {
    "full": "similar to ours by the full transformation",
    "planar_both": "similar to ours with path and estimate both by yaw alone",
    "planar": "similar to ours by yaw alone, an error that no filter can correct",
}
ENKF, FKF = "EnKF8 N=50", "fuzzy 0..1"  # our counterparts of the printed filters
GOLDEN = math.sqrt((math.sqrt(5.0) - 1.0) / 2.0 * NOISE)  # P = 0.618 R: Q = R, and the state itself is measured
MEAN_ONLY = math.sqrt(2.0 / 3.0 * NOISE)  # the same for a gain of 1/2
NO_POSTERIOR_BOUND = (
    "The bound is the Riccati recursion along the noise-free path. The posterior Cramer-Rao bound is useless "
    "here: roll and pitch have a noise of 1e-6 rad a step, and its averages over truths take the smallest "
    "differences of Jacobians for information: a pitch to 3 mrad, where a consistent filter has 10."
)
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


PRINTED_INVERSE = np.array(
    [
        [0.162, -0.0024, 0.8989, 0.0011, 0.098, 0.0001],
        [-0.0012, -0.8175, -0.0206, -0.0431, -0.0024, 0.0969],
        [1.8855, -0.0418, -1.023, -0.0036, -0.2205, 0.0024],
        [-0.0518, 0.8865, 0.0511, 1.0468, 0.0088, -0.105],
        [15.9131, -0.3634, -17.0743, -0.0425, -1.8611, 0.0213],
        [-0.0128, 15.7327, 0.1966, 0.8288, 0.024, -0.8641],
    ]
)
"""A^-1 of equation (19), A the mass matrix with each row divided by its diagonal; "-08641" is read as -0.8641.

Its inverse has a diagonal of ones to 8e-4 and the zeros of such a matrix, so the print holds what was meant. But
its entries imply Xud = Yvd = Zwd, Ix - Kpd < 0 and Iy - Mqd = 0.09 kg m^2 for a body of 15 kg and almost a
metre, and eigenvalues -0.24 and -0.49: an indefinite mass matrix, of which no vehicle has one.
"""


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


def unstable_corners(low=FUZZY_LOW, high=FUZZY_HIGH, world: str = "vehicle") -> tuple[int, float]:
    """How many of the 64 matrices A in I + A dt of a fuzzy filter are unstable, and the fastest growth [1/s]."""
    rules = FuzzyKalmanFilter(model=level_model(world), low=np.array(low), high=np.array(high)).rules
    rates = [(rule.matrices()[0] - np.eye(6)) / DT for rule in rules]
    growth = np.array([np.linalg.eigvals(rate).real.max() for rate in rates])
    return int((growth > 1e-6).sum()), float(growth.max())


def statements(paper: str, results: list[PathResult]) -> list[str]:
    """Statements that compare a paper's tables with ours."""
    by_path = {result.path: result for result in results if result.world == "vehicle"}
    if paper == NGATINI2019.name:
        iv = by_path["IV"]
        return [*_of_transformation(iv), *_of_members(iv), *_of_attitude(iv), _of_matrix()]
    (other,) = [result for result in results if result.world != "vehicle"]
    return [*_of_paths(by_path), *_of_bounds(by_path), *_of_other_world(other)]


def _of_transformation(iv: PathResult) -> list[str]:
    printed = np.array([list(row.rmse.values()) for row in TABLE_III.values()])
    flat = 100 * (printed.max(axis=0) / printed.min(axis=0) - 1.0).max()
    by_yaw = np.array([scores.rmse("planar") for scores in iv.scores.values()])
    ours = 100 * (by_yaw.max(axis=0) / by_yaw.min(axis=0) - 1.0).max()
    gap, full = iv.planar_gap, iv.scores["EKF8"].rmse("full")
    return [
        f"The printed errors differ by {flat:.1f} % at most between 50 and 300 members, ours by yaw alone by "
        f"{ours:.1f} % between all filters and the bare measurements: they do not measure the filter. The vehicle "
        f"dives by pitching, which yaw alone ignores: on true velocities without noise its RMSE is {_pose(gap)}. "
        f"By the full transformation the EKF has {_pose(full)}.",
    ]


def _of_members(iv: PathResult) -> list[str]:
    scores, printed = iv.scores, TABLE_III
    ours = [scores[f"EnKF8 N={count}"] for count in printed]
    kalman = ("EKF8", "UKF8", "EKF6 level", "EKF6 own attitude")
    measured = 1e3 * np.array([scores[label].rmse("velocities")[list(MEASURED_PLACES)] for label in kalman])
    nees = ", ".join(f"{digits(of_members.nees_interval.value)}" for of_members in ours)
    (mean_only,) = [of_mean for label, of_mean in scores.items() if "eq. (24)" in label]
    return [
        f"A measured velocity with Q = R is estimated to sqrt(0.618 R) = {1e3 * GOLDEN:.3f} mm/s (or mrad/s) "
        f"with any filter; extended and unscented ones have {measured.min():.3f} to {measured.max():.3f}. Only p, "
        "q, roll and pitch distinguish filters.",
        f"The NEES of the EnKF for N = {', '.join(map(str, printed))} is {nees} for 8 states, that of the EKF "
        f"{digits(scores['EKF8'].nees_interval.value)}: at 1 kHz each update reduces the spread of roll and "
        "pitch by chance correlations, and nothing restores it. Seconds are printed for an unknown number of "
        "steps.",
        "Equation (24) discards the members, so its gain is 1/2 for measured states: sqrt(2/3 R) = "
        f"{1e3 * MEAN_ONLY:.3f} mm/s in theory, {1e3 * mean_only.rmse('velocities')[0]:.3f} mm/s with the "
        f"sampling noise of its members. p and q come only from the model, {_rates(mean_only)}; the correct EnKF, "
        f"disturbed by chance correlations, has {_rates(ours[0])}.",
    ]


def _of_attitude(iv: PathResult) -> list[str]:
    level, reckoned, eight = (iv.scores[label] for label in ("EKF6 level", "EKF6 own attitude", "EKF8"))
    rates = [1e3 * scores.rmse("velocities")[3:5] for scores in (eight, reckoned, level)]
    return [
        "The papers' six states are not closed: weight and buoyancy depend on roll and pitch. RMSE of p and q "
        f"[mrad/s] and NEES of an EKF of six states: {rates[2][0]:.0f}, {rates[2][1]:.0f}, "
        f"{digits(level.nees_interval.value)} with zero roll and pitch; {rates[1][0]:.1f}, {rates[1][1]:.1f}, "
        f"{digits(reckoned.nees_interval.value)} with its own dead-reckoned attitude. The EKF of eight states: "
        f"{rates[0][0]:.1f}, {rates[0][1]:.1f}.",
        NO_POSTERIOR_BOUND,
    ]


def _of_matrix() -> str:
    printed = np.sort(np.linalg.eigvals(np.linalg.inv(PRINTED_INVERSE)).real)
    ours = np.linalg.eigvalsh(mass_matrix(SEGOROGENI))
    return (
        f"The inverse of the printed A^-1 has eigenvalues {', '.join(f'{value:.2f}' for value in printed)}: two "
        f"are negative, so no vehicle has this mass matrix. Ours has "
        f"{', '.join(f'{value:.3g}' for value in ours)}, derived from the printed sizes."
    )


def _of_paths(by_path: dict[str, PathResult]) -> list[str]:
    worse, printed_worse = [], []
    for name, result in by_path.items():
        ratio = position_ratio(result.scores[FKF], result.scores[ENKF], "full")
        worse.append(f"{name} {with_interval(ratio)}")
        enkf, fkf = (row.rmse for row in PRINTED_PATHS[name][:2])
        printed_worse.append(f"{name} {math.hypot(*_metres(fkf)) / math.hypot(*_metres(enkf)):.2g}")
    planar = [
        position_ratio(result.scores[FKF], result.scores[MEASUREMENTS], "planar").value
        for result in by_path.values()
    ]
    dynamic = by_path["dynamic"].scores[ENKF]
    return [
        "Position RMSE of the fuzzy filter over that of the EnKF with 50 members, printed: "
        f"{', '.join(printed_worse)}. Ours, by the full transformation and paired by run: {', '.join(worse)}. "
        "We cannot reproduce that the fuzzy filter wins on four paths; by yaw alone it has "
        f"{min(planar):.2f} to {max(planar):.2f} times the error of the bare measurements.",
        "On the dynamic path 1.5 mm, 1.4 mm and 1.1 mrad are printed for the EnKF. Ours has "
        f"{_level_pose(dynamic.rmse('planar_both'))} with path and estimate both by yaw alone, and "
        f"{_level_pose(dynamic.rmse('full'))} by the full transformation. z, which is not printed, is worse, "
        f"because pitch is not measured: {digits(dynamic.rmse('full')[2])} m.",
        f"We can reproduce that 50 members are faster than 64 rules; printed are {_seconds_ratio()} times.",
    ]


def _of_bounds(by_path: dict[str, PathResult]) -> list[str]:
    outside = ", ".join(f"{name} {100 * result.outside[-1]:.0f} %" for name, result in by_path.items())
    count, growth = unstable_corners()
    return [
        "The bounds 0..1 exclude every negative velocity. Without noise the share of time in which some "
        f"velocity lies outside is {outside}. Corners such as v = w = 1 m/s are ten times the vehicle's "
        f"velocities; {count} of the 64 tangents are unstable, the worst grows by {growth:.2f}/s.",
        NO_POSTERIOR_BOUND,
    ]


def _of_other_world(other: PathResult) -> list[str]:
    scores = other.scores
    base = scores["EKF6 level"]
    words = {
        FKF: "bounds 0..1",
        "fuzzy 0..1 own": "the same with a separate estimate for each rule",
        "fuzzy narrow offsets": "a range around the manoeuvre, with offsets",
    }
    comparisons = []
    for label, what in words.items():
        p, q = scores[label].rmse("velocities")[3:5] / base.rmse("velocities")[3:5]
        ratio = position_ratio(scores[label], base, "full")
        comparisons.append(f"{what}: p {p:.2g}, q {q:.2g}, position {with_interval(ratio)}")
    ensembles = ", ".join(
        f"{digits(of_filter.nees_interval.value)}"
        for label, of_filter in scores.items()
        if label.startswith("EnKF6") and "(24)" not in label
    )
    return [
        "On equal terms, in a world without restoring moments where six states are exact, the fuzzy filter's "
        f"RMSE over that of the EKF of six states: {'; '.join(comparisons)}. The NEES of that EKF is "
        f"{digits(base.nees_interval.value)}, of the EnKF {ensembles} for N = 50, 100, 200, 300.",
    ]


def _metres(rmse) -> list[float]:
    return [value for name, value in rmse.items() if name != "psi"]


def _seconds_ratio() -> str:
    ratios = [path.fkf.seconds / path.enkf.seconds for path in PRINTED_PATHS.values()]
    return f"{min(ratios):.2g} to {max(ratios):.2g}"


def _pose(values: np.ndarray) -> str:
    metres = ", ".join(f"{name} {value:.3g} m" for name, value in zip(POSE[:3], values[:3], strict=True))
    return f"{metres}, psi {values[3]:.2g} rad"


def _level_pose(values: np.ndarray) -> str:
    return f"x {digits(values[0])} m, y {digits(values[1])} m, psi {digits(values[3])} rad"


def _rates(scores: Scores) -> str:
    p, q = 1e3 * scores.rmse("velocities")[3:5]
    return f"{digits(p)} and {digits(q)} mrad/s"


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
    compared, conclusions = findings(name, results), statements(name, results)
    first = [members(results[0])] if name == NGATINI2019.name else [paths(results), ends(results)]
    output: list[Any] = [*first, *(velocities(result, "EKF8") for result in results)]
    output += ["Conclusions from the runs", *conclusions, f"{name}: {PAPERS[name].source}", *PAPERS[name].remarks]
    data = {
        "settings": {"runs": runs, "seed": seed, "steps": steps},
        "source": PAPERS[name].source,
        "results": [plain_result(result, compared) for result in results],
        "statements": conclusions,
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


def paper_sentences() -> str:
    """Lists of statements on the results of both papers."""
    blocks: list[str] = []
    for paper in RUNS_OF:
        new = [
            sentence for sentence in statements(paper, results(paper)) if not any(sentence in b for b in blocks)
        ]
        blocks.append(f"{paper}:\n\n" + "\n".join(f"- {sentence}" for sentence in new))
    return "\n" + "\n\n".join(blocks)


def _of_page(table: Callable[[], Table]) -> Callable[[], str]:
    def markdown() -> str:
        _, columns, rows, *_ = table()
        return markdown_table(columns, rows)

    return markdown


FIGURES = {"auv_papers.png": lambda path: paths_figure(path, path_runs("ngatini2017"))}
TABLES = {
    "papers_members": _of_page(lambda: members(results("ngatini2019")[0])),
    "papers_velocities": _of_page(lambda: velocities(results("ngatini2019")[0], omitted=NOT_ON_PAGE)),
    "papers_paths": _of_page(lambda: paths(results("ngatini2017"))),
    "papers_ends": _of_page(lambda: ends(results("ngatini2017"))),
    "papers_world": _of_page(lambda: velocities(results("ngatini2017")[-1], "EKF6 level", NOT_ON_PAGE)),
    "papers_said": paper_sentences,
}
