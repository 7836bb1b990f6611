"""`thruster reproduce`: published tables, and those of standard problems, compared with many runs of ours."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.text import Text

from filters.ensembles.ensemble import LARGEST_ENSEMBLE
from thruster_env.core.checks import at_least, one_of
from thruster_env.core.files import check_target
from thruster_env.core.text_tables import table
from tuning.cli import options
from tuning.cli.benchmark import fitted, list_of, reproduce_benchmark
from tuning.cli.options import JsonOption, SeedOption
from tuning.cli.output import announce_compilation, check_picture, emit, progress_console
from tuning.cli.vehicle import reproduce_vehicle
from tuning.experiments import BENCHMARKS, STUDIES, VEHICLE_STUDIES
from tuning.experiments.benchmark import RUNS as BENCHMARK_RUNS
from tuning.experiments.thruster_papers import (
    MEMBERS,
    MOST_RUNS,
    RUNS,
    all_series,
    compare_all,
    findings,
    general_statements,
    series_figure,
    study_statements,
)
from tuning.experiments.vehicle.experiment import MOST_RUNS as MOST_VEHICLE_RUNS
from tuning.experiments.vehicle.papers import RUNS as VEHICLE_RUNS

ALL = "all"
LINES = "In each cell first omega_m [rad/s], below it U_a [m/s]."


def command(
    study: Annotated[
        str,
        typer.Argument(
            help=f"A paper on the bow thruster: {', '.join(STUDIES)}, or {ALL} of them; "
            f"or on the underwater vehicle: {', '.join(VEHICLE_STUDIES)}; or a standard problem: "
            f"{', '.join(BENCHMARKS)}."
        ),
    ],
    runs: Annotated[
        int | None,
        typer.Option(
            help=f"Independent runs, at least 2; by default {RUNS} of 100 steps for a paper on the thruster, "
            f"{VEHICLE_RUNS} of some 25000 for one on the vehicle, and {BENCHMARK_RUNS} for a standard problem; "
            "with fewer the intervals are wide.",
            rich_help_panel=options.RUNS,
        ),
    ] = None,
    members: Annotated[
        int | None,
        typer.Option(
            help=f"Ensemble size N of the papers' EnKF, at least 2; {MEMBERS} by default.",
            rich_help_panel=options.FILTER,
        ),
    ] = None,
    series: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Also draw one run over time for each system and q, as the papers do, or the vehicle's paths: "
            ".png, .svg or .pdf; into --json, too.",
            rich_help_panel=options.OUTPUT,
        ),
    ] = None,
    steps: Annotated[
        int | None,
        typer.Option(
            help="First steps of 1 ms of each of the vehicle's paths, for a quick look; all by default.",
            rich_help_panel=options.RUNS,
        ),
    ] = None,
    seed: SeedOption = 0,
    json: JsonOption = None,
) -> None:
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
    """
    one_of("study", study, (*STUDIES, ALL, *VEHICLE_STUDIES, *BENCHMARKS))
    if members is not None and study not in (*STUDIES, ALL):
        raise ValueError(f"--members must come with a paper on the thruster, but got {study!r}")
    if steps is not None and study not in VEHICLE_STUDIES:
        raise ValueError(f"--steps must come with a paper on the vehicle, but got {study!r}")
    if study in BENCHMARKS:
        if series is not None:
            raise ValueError(f"--series must come with a paper, but got {study!r}")
        emit(*reproduce_benchmark(study, BENCHMARK_RUNS if runs is None else runs, seed), json)
        return
    if series is not None:
        check_picture(series, "--series")
        check_target(series)
    if study in VEHICLE_STUDIES:
        runs = at_least("runs", VEHICLE_RUNS if runs is None else runs, 2, MOST_VEHICLE_RUNS)
        emit(*reproduce_vehicle(study, runs, seed, steps, series), json)
        return
    names = tuple(STUDIES) if study == ALL else (study,)
    runs = at_least("runs", RUNS if runs is None else runs, 2, MOST_RUNS)
    members = at_least("members", MEMBERS if members is None else members, 2, LARGEST_ENSEMBLE)
    output, data = reproduce(names, runs, members, seed)
    if series is not None:
        drawn = all_series(members=members, seed=seed)
        output += ["", f"Picture: {series_figure(series, drawn, members)}"]
        data |= {"series": [run._asdict() for run in drawn], "picture": str(series)}
    emit(output, data, json)


def reproduce(names: tuple[str, ...], runs: int = RUNS, members: int = MEMBERS, seed: int = 0):
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
        results = findings(STUDIES[name], comparisons)
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
    announce_compilation()
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
    return fitted(table(title, columns, rows, caption=caption), rows)


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
    out = table(f"{name}, {case}: published RMSE against ours", columns, rows, caption=caption)
    return fitted(out, rows, flexible=why)


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
