"""`thruster reproduce`: published tables, and those of standard problems, compared with many runs of ours.

The papers on the underwater vehicle on the terminal: their tables beside ours, and conclusions.

Standard problems on the terminal: published results beside ours, and why they differ.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from rich.console import RenderableType
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table as RichTable
from rich.text import Text

from filters.consistency.intervals import Interval, mean_interval
from filters.ensembles.ensemble import LARGEST_ENSEMBLE
from thruster_env.core.checks import at_least, one_of
from thruster_env.core.files import check_target
from thruster_env.core.text_tables import Table, console
from thruster_env.logs.write import check_picture
from tuning.api.markers import FILTER, INPUT, OUTPUT, WRITTEN, Argument, Option, Seed
from tuning.api.markers import RUNS as RUNS_PANEL
from tuning.api.result import Printed
from tuning.cli.output import progress_console
from tuning.experiments import BENCHMARKS, STUDIES, VEHICLE_STUDIES
from tuning.experiments.benchmark import RUNS as BENCHMARK_RUNS
from tuning.experiments.benchmark import WHY, Benchmark, Row, find_benchmark
from tuning.experiments.thruster_papers import (
    MEMBERS,
    MOST_RUNS,
    all_series,
    compare_all,
    general_statements,
    series_figure,
    study_statements,
)
from tuning.experiments.thruster_papers import RUNS as PAPER_RUNS
from tuning.experiments.thruster_papers import findings as paper_findings
from tuning.experiments.vehicle.estimators import MEASUREMENTS
from tuning.experiments.vehicle.experiment import MOST_RUNS as MOST_VEHICLE_RUNS
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
from tuning.experiments.vehicle.papers import RUNS as VEHICLE_RUNS
from tuning.experiments.vehicle.tables import ENKF, FKF, Finding, digits, findings, statements, with_interval


def reproduce_benchmark(name: str, runs: int, seed: int) -> tuple[list[RenderableType], dict]:
    """Solve a standard problem; return what to show, as a list and as plain data."""
    benchmark = find_benchmark(name)
    with progress_console.status("...") as status:
        rows = benchmark.reproduce(runs, seed, lambda row: status.update(f"done: {row.label}"))
    output: list[RenderableType] = [_table(benchmark, rows, runs), Text(""), Text(f"{name}: {benchmark.source}")]
    if benchmark.remarks:
        output.append(list_of(benchmark.remarks))
    return output, {
        "settings": {"runs": runs, "seed": seed},
        "source": benchmark.source,
        "score": benchmark.score,
        "theirs": benchmark.theirs,
        "rows": [row._asdict() | {"ratio": row.ratio, "why": row.why} for row in rows],
        "statements": list(benchmark.remarks),
    }


def _table(benchmark: Benchmark, rows: list[Row], runs: int) -> RichTable:
    columns = benchmark.header
    columns[2] = f"ours ({runs} runs)"
    cells = [row.cells() for row in rows]
    for row in cells:
        row[2] = row[2].replace(" [", "\n[")
    compared = f"The table compares {benchmark.score}, ours with its 95 % interval."
    caption = f"{compared} Median run: median score of single runs. Pooled: the RMSE of our tables."
    out = fitted(Table(benchmark.about, columns, cells, caption=caption), flexible=WHY)
    out.columns[0].width = None
    return out


LEAST = 12  # width of a column of words


def fitted(table: Table, flexible: str = "") -> RichTable:
    """The table with a blank line between rows of two lines, and numbers that do not wrap where there is room."""
    out, rows = table.__rich__(), table.rows
    out.leading = 1
    fixed = [i for i, column in enumerate(out.columns) if str(column.header) != flexible]
    widths = [max(len(line) for row in rows for line in row[i].split("\n")) for i in fixed]
    if sum(widths) + 2 * len(out.columns) + (LEAST if flexible else 0) > console.width:
        return out
    for i, column in enumerate(out.columns):
        if str(column.header) == flexible:
            column.justify = "left"
        else:
            lines = [line for row in rows for line in row[i].split("\n")]
            column.width = max(len(text) for text in lines + str(column.header).split())
    return out


def list_of(statements: Sequence[str]) -> RichTable:
    """Statements as a list."""
    out = RichTable.grid(padding=(0, 1))
    for statement in statements:
        out.add_row("-", Text(statement))
    return out


# Tables of the papers on the underwater vehicle.


WHY_PAPERS = "why they differ"
POSES = "In each cell x, y, z [m] and psi [rad], one below the other."
FIELDS = {"planar": "by yaw alone", "planar_both": "both by yaw", "full": "full"}


def particulars_table() -> Table:
    """Table I, beside the values of our vehicle."""
    ours = {"mass": "15", "length": "0.98", "beam": "0.188", "speed": "1.94 (1 m/s) at 2.85 N"}
    rows = [
        [f"{name} [{unit}]", f"{value:g}", ours.get(name, "not in the equations")]
        for name, (value, unit) in PARTICULARS.items()
    ]
    return Table("ngatini2019, table I: the vehicle", ["", "published", "ours"], rows, words=True)


def published_table(paper: str, result: PathResult, findings: list[Finding]) -> RichTable:
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
    columns = ["filter", "published", *FIELDS.values(), "s", WHY_PAPERS]
    caption = (
        f"{POSES} By yaw alone: the papers' transformation, against the true path. Both by yaw: against the "
        "path that true velocities give by yaw alone. Full: with roll and pitch. s: seconds of a run, "
        'published above ours, of one core. "Similar" means within a factor of 3.'
    )
    title = f"{paper}, path {_name(result)}: published RMSE against ours"
    return fitted(Table(title, columns, rows, caption=caption), flexible=WHY_PAPERS)


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
    return Table(f"path {_name(result)}: RMSE of velocities and attitude", columns, rows, caption=caption)


def position_table(result: PathResult) -> RichTable:
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
    return fitted(Table(f"path {_name(result)}: position", columns, rows, caption=caption))


def end_table(results: list[PathResult]) -> RichTable:
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
    return fitted(Table(title, columns, rows, caption=caption))


def outside_table(results: list[PathResult]) -> Table:
    """The time that each velocity is outside the fuzzy filter's bounds."""
    rows = [
        [result.path, *(f"{100 * share:.0f}" for share in result.outside)]
        for result in results
        if result.world == "vehicle"
    ]
    title = "Time outside the fuzzy filter's bounds 0..1 [%], without noise"
    return Table(title, ["path", *"uvwpqr", "any"], rows)


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


ALL = "all"
PUBLISHED = f"{', '.join(STUDIES)}; {ALL}; {', '.join(VEHICLE_STUDIES)}; {', '.join(BENCHMARKS)}."
RUNS_BY_DEFAULT = (
    f"{PAPER_RUNS} of 100 steps for a paper on the thruster, {VEHICLE_RUNS} of some 25000 for one on "
    f"the vehicle, and {BENCHMARK_RUNS} for a standard problem."
)
LINES = "In each cell first omega_m [rad/s], below it U_a [m/s]."


def command(
    study: Annotated[str, Argument(INPUT, listed=PUBLISHED)],
    runs: Annotated[int | None, Option(RUNS_PANEL, listed=RUNS_BY_DEFAULT)] = None,
    members: Annotated[int | None, Option(FILTER, listed=f"{MEMBERS}.")] = None,
    series: Annotated[Path | None, Option(OUTPUT, metavar="FILE", file=WRITTEN)] = None,
    steps: Annotated[int | None, Option(RUNS_PANEL)] = None,
    seed: Seed = 0,
) -> Printed:
    """Repeat a published experiment many times and say why its table differs from ours.

    The papers compare a Kalman filter (KF) with an ensemble Kalman filter
    (EnKF) on two linear bow thrusters, tunnel and open-bladed, at Q = R = q I
    for four values of q, apparently by the RMSE of one run.

    Here both filters see the same runs. Three more columns show what to expect: the Riccati optimum, which no
    filter can beat; the start from P_0 = I; and a wrong filter, whose ensemble is never updated, which gives the
    published open-bladed EnKF. Every published value comes with its distance in standard deviations of a single
    run, and the reason for the difference.

    The papers on the underwater vehicle compare ensemble and fuzzy Kalman
    filters at 1 kHz by the RMSE of its path. The tables add other filters and the bare measurements, on the same
    runs, with the papers' transformation and with the right one.

    A standard problem compares our filters with published results, or with another package on the same data.

    Example: thruster reproduce nurhadi2022 --series series.png --json table.json

    Example: thruster reproduce ngatini2019 --series paths.png

    Example: thruster reproduce lorenz63

    Args:
        study: a paper on the bow thruster, all of them, a paper on the underwater vehicle, or a standard problem:
        runs: independent runs, at least 2; few make wide intervals. By default:
        members: ensemble size N of the papers' EnKF, at least 2. By default:
        series: also draw one run over time for each system and q, as the papers do, or the vehicle's paths: .png,
            .svg or .pdf; into --json, too.
        steps: first steps of 1 ms of each of the vehicle's paths, for a quick look; all by default.
        seed: seed of all randomness; the same seed gives the same results.
    """
    one_of("study", study, (*STUDIES, ALL, *VEHICLE_STUDIES, *BENCHMARKS))
    if members is not None and study not in (*STUDIES, ALL):
        raise ValueError(f"--members must come with a paper on the thruster, but got {study!r}")
    if steps is not None and study not in VEHICLE_STUDIES:
        raise ValueError(f"--steps must come with a paper on the vehicle, but got {study!r}")
    if study in BENCHMARKS:
        if series is not None:
            raise ValueError(f"--series must come with a paper, but got {study!r}")
        return Printed(*reproduce_benchmark(study, BENCHMARK_RUNS if runs is None else runs, seed))
    if series is not None:
        check_picture(series, "--series")
        check_target(series)
    if study in VEHICLE_STUDIES:
        runs = at_least("runs", VEHICLE_RUNS if runs is None else runs, 2, MOST_VEHICLE_RUNS)
        return Printed(*reproduce_vehicle(study, runs, seed, steps, series))
    names = tuple(STUDIES) if study == ALL else (study,)
    runs = at_least("runs", PAPER_RUNS if runs is None else runs, 2, MOST_RUNS)
    members = at_least("members", MEMBERS if members is None else members, 2, LARGEST_ENSEMBLE)
    output, data = reproduce(names, runs, members, seed)
    if series is not None:
        drawn = all_series(members=members, seed=seed)
        output += ["", f"Picture: {series_figure(series, drawn, members)}"]
        data |= {"series": [run._asdict() for run in drawn], "picture": str(series)}
    return Printed(output, data)


def reproduce(names: tuple[str, ...], runs: int = PAPER_RUNS, members: int = MEMBERS, seed: int = 0):
    """Run the published experiments of some studies; return what to show, as a list and as plain data."""
    comparisons = _compare(runs, members, seed)
    blank = Text()
    output, general = [], general_statements(comparisons)
    for case in dict.fromkeys(c.case for c in comparisons):
        output += [_own_table(case, [c for c in comparisons if c.case == case], runs, members), blank]
    studies: dict[str, Any] = {}
    data = {
        "settings": {"runs": runs, "members": members, "seed": seed},
        "states": ["omega_m [rad/s]", "U_a [m/s]"],
        "results": [_plain_comparison(c) for c in comparisons],
        "studies": studies,
        "statements": general,
    }
    for name in names:
        results = paper_findings(STUDIES[name], comparisons)
        for case in dict.fromkeys(f.case for f in results):
            output += [_published_table(name, case, [f for f in results if f.case == case]), blank]
        statements = study_statements(STUDIES[name], results)
        output += [Text(f"{name}: {STUDIES[name].source}"), list_of(statements), blank]
        studies[name] = {
            "source": STUDIES[name].source,
            "rows": [_plain_finding(f) for f in results],
            "statements": statements,
        }
    return [*output, Text("Conclusions from the runs"), list_of(general)], data


def _compare(runs: int, members: int, seed: int):
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=progress_console) as progress:
        task = progress.add_task(f"{runs} runs of each case and noise level", total=None)
        return compare_all(
            runs=runs,
            members=members,
            seed=seed,
            on_progress=lambda done, total: progress.update(task, completed=done, total=total),
        )


def _own_table(case: str, comparisons: list, runs: int, members: int):
    rows = []
    for c in comparisons:
        for start, kf, enkf in (("P_inf", c.kf, c.enkf), ("I", c.kf_identity, c.enkf_identity)):
            ratio = _lines(enkf.rmse / kf.rmse, ".3f")
            rows.append([f"{c.q:g}", start, _lines(c.optimum), _intervals(kf), _intervals(enkf), ratio])
    columns = ["q", "P_0", "Riccati optimum", "KF, 95 % interval", "EnKF, 95 % interval", "EnKF / KF"]
    title = f"{case}: RMSE of {runs} runs of 100 steps, EnKF with {members} members"
    caption = f"{LINES} P_0: covariance of x_0 and of the filter's prior."
    return fitted(Table(title, columns, rows, caption=caption))


def _published_table(name: str, case: str, findings: list):
    rows = []
    for f in findings:
        free = f.from_unupdated is not None
        rows.append(
            [
                f"{f.q:g}",
                "EnKF" if f.filter == "enkf" else "KF",
                _lines(f.published[:2]),
                _lines(f.ours.rmse),
                _distances(f.optimum, f.from_optimum),
                _distances(f.unupdated.rmse, f.from_unupdated) if free else "",
                f.why,
            ]
        )
    why = "why they differ"
    columns = ["q", "filter", "published", "ours", "optimum (sd)", "un-updated ensemble (sd)", why]
    caption = (
        f"{LINES} (sd): distance of the published value above ours, in standard deviations of a single run's "
        "RMSE. Un-updated ensemble: a wrong filter, see below."
    )
    out = Table(f"{name}, {case}: published RMSE against ours", columns, rows, caption=caption)
    return fitted(out, flexible=why)


def _lines(values, form: str = ".4f") -> str:
    return "\n".join(format(value, form) for value in values)


def _intervals(score) -> str:
    return "\n".join(
        f"{rmse:.4f} [{low:.4f}, {high:.4f}]"
        for rmse, low, high in zip(score.rmse, score.low, score.high, strict=True)
    )


def _distances(centre, distances) -> str:
    return "\n".join(
        f"{value:.4f} ({round(sd, 1) + 0.0:+.1f})" for value, sd in zip(centre, distances, strict=True)
    )


def _plain_comparison(c) -> dict:
    return {name: v._asdict() if hasattr(v, "_asdict") else v for name, v in c._asdict().items()} | {
        "enkf_over_kf": c.enkf_over_kf
    }


def _plain_finding(f) -> dict:
    return {
        "case": f.case,
        "q": f.q,
        "filter": f.filter,
        "published": list(f.published[:2]),
        "note": f.published.note,
        "in_text": f.published.in_text,
        "sd_from_optimum": f.from_optimum,
        "sd_from_unupdated": f.from_unupdated,
        "published_over_optimum": f.over_optimum,
        "why": f.why,
    }
