"""`thruster estimate`: a filter or a smoother over a recorded log."""

from __future__ import annotations

from dataclasses import asdict
from math import isnan
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import RenderableType

from filters.logs.estimate import LogEstimate, estimate
from filters.logs.findings import (
    ALPHA,
    LogAlarms,
    LogFindings,
    Residual,
    alarms_of,
    columns_of,
    episode_sentence,
    episodes,
    findings,
    verdict,
)
from thruster_env.core.text_tables import table
from thruster_env.logs.write import check_suffix, write_columns
from tuning.cli.options import (
    A_LOG,
    FILTER,
    FILTER_HELP,
    OUTPUT,
    RUNS,
    GridOptions,
    JsonOption,
    MonitorOption,
    SeedOption,
    asked_monitor,
    filter_option,
    one_file,
    with_groups,
)
from tuning.cli.output import announce_compilation, check_picture, check_targets, emit
from tuning.logs.read import as_tuned, read_named

MOST_EPISODES = 8  # that are shown


@with_groups
def command(
    log: Annotated[Path, typer.Argument(metavar="LOG", help=A_LOG)],
    file: Annotated[Path | None, typer.Argument(metavar="FILE", help="Tuned file, with filter, Q and R.")] = None,
    filter_name: Annotated[
        str | None,
        filter_option(f"Without a tuned file; ekf by default. {FILTER_HELP}"),
    ] = None,
    tuned: Annotated[
        Path | None, typer.Option(metavar="FILE", help="The same as the argument.", rich_help_panel=FILTER)
    ] = None,
    *,
    reading: GridOptions,
    ensemble_size: Annotated[
        int | None,
        typer.Option(help="Ensemble size; 100 by default, 1000 for particles.", rich_help_panel=FILTER),
    ] = None,
    smoother: Annotated[
        bool, typer.Option("--smoother", help="Also use later measurements.", rich_help_panel=FILTER)
    ] = False,
    lag: Annotated[
        int | None,
        typer.Option(help="Smoother with that many later measurements; all by default.", rich_help_panel=FILTER),
    ] = None,
    skip: Annotated[
        int | None,
        typer.Option(
            help="Number of initial rows that are not scored; 50, or a quarter of a short log, by default.",
            rich_help_panel=RUNS,
        ),
    ] = None,
    monitor: MonitorOption = None,
    isolate: Annotated[
        bool,
        typer.Option(
            "--isolate",
            help="Also run the filter without each channel, and name the faulty one.",
            rich_help_panel=RUNS,
        ),
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option(help="Estimates, bands and innovations as .csv, .parquet or .npz.", rich_help_panel=OUTPUT),
    ] = None,
    plot: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Picture of everything over time, .png, .svg or .pdf.", rich_help_panel=OUTPUT
        ),
    ] = None,
    seed: SeedOption = 0,
    json: JsonOption = None,
) -> None:
    """Estimate the state of a recorded run, and report what the innovations say about filter and model.

    The log has the model's inputs and measurements, found by the headers of its columns or given by --column.
    States or outputs of the model in the log, such as the thrust of a load cell that the filter does not see, are
    compared with the estimate. docs/logs.md has the rules.

    Example: thruster estimate run.csv --tuned tuned.json --out est.csv --plot est.png

    Example: thruster estimate run.csv --sensor speed --column speed=motor_rpm --column thrust=loadcell[kgf]
    """
    if file is not None and log.suffix == ".json":  # the other way round
        log, file = file, log
    tuned = one_file(file, tuned)
    if tuned is not None and filter_name is not None:
        raise ValueError(f"give either a tuned file or --filter NAME, but got both, {tuned} and {filter_name}")
    if plot is not None:
        check_picture(plot, "--plot")
    if out is not None:
        check_suffix(out)
    watch = asked_monitor(monitor, tuned)
    if isolate and watch is None:
        raise ValueError("--isolate must come with --monitor STEPS, whose alarms it counts")
    recorded, offer = read_named(log, **as_tuned(reading.named(), tuned))
    check_targets((out, plot), json, read=(log, tuned, reading.preset))
    announce_compilation()
    numbers = {} if ensemble_size is None else {"ensemble_size": ensemble_size}
    options: dict[str, Any] = {"tuned": tuned, "smoother": smoother, "lag": lag, "seed": seed, **numbers}
    estimates = estimate(recorded, filter_name, offer, **options)
    assessment = findings(estimates, skip)
    alarms = None if watch is None else alarms_of(estimates, watch, assessment.first, isolate=isolate)
    if out is not None:
        write_columns(out, columns_of(estimates, alarms), again=True)
    if plot is not None:
        from filters.logs.findings import log_figure

        log_figure(plot, estimates, f"{_title(estimates)} on {log.name}", alarms)
    files = [str(path) for path in (out, plot) if path is not None]
    output = [*_report(estimates, assessment), *_alarms(estimates, alarms), *[f"wrote {path}" for path in files]]
    emit(output, {**_as_json(estimates, assessment), **_alarms_as_json(estimates, alarms), "files": files}, json)


def _title(estimates: LogEstimate) -> str:
    return f"{estimates.filter.name}, smoothed," if estimates.smoothed else estimates.filter.name


def _report(estimates: LogEstimate, assessment: LogFindings) -> list[RenderableType]:
    log = estimates.log
    how = ", on its own stamps" if log.stamps is not None else ", put on a grid" if log.irregular else ""
    about = f"{log.steps + 1} rows, dt {log.dt:g} s{how}"
    title = f"{_title(estimates)} on {log.name} ({about}); scored: rows {assessment.first} to {log.steps}"
    rows = [
        [
            "mean NIS over channels",
            f"{assessment.mean_nis:.3g}",
            f"{assessment.nis_band[0]:.3g} to {assessment.nis_band[1]:.3g}",
        ],
        ["log-likelihood", f"{assessment.log_likelihood:.6g}", ""],
        ["restarts", str(estimates.divergences), "0"],
    ]
    if isnan(assessment.mean_nis):
        rows = rows[2:]
    elif assessment.whiteness is not None:
        white = assessment.whiteness
        rows.insert(1, ["whiteness, p-value", f"{white.p_value:.3g}", f"above {ALPHA:g}"])
    output: list[RenderableType] = [table(title, ["innovations", "", "if consistent"], rows)]
    columns = ["", "RMSE", "bias", "rows"]
    output.append(table("One-step prediction less measurement", columns, list(map(_row, assessment.predictions))))
    if assessment.references:
        what = "Smoother" if estimates.smoothed else "Estimate"
        output.append(table(f"{what} less reference, not seen", columns, list(map(_row, assessment.references))))
    return output + verdict(estimates, assessment)


def _alarms(estimates: LogEstimate, alarms: LogAlarms | None) -> list[RenderableType]:
    """The first alarms in words, and the channel at fault."""
    if alarms is None:
        return []
    log, times = estimates.log, estimates.log.start + estimates.log.times
    rows, expected = log.steps + 1 - alarms.first, (log.steps + 1 - alarms.first) / alarms.monitor.steps_between
    what = f"{rows} rows, {expected:.2g} false alarms expected if the model is right"
    if not alarms.alarms:
        return [f"No alarm in {what}."]
    stretches = episodes(alarms.alarms, alarms.monitor.memory)
    output: list[RenderableType] = [f"Alarms: {len(alarms.alarms)} in {what}."]
    output += [
        f"- {episode_sentence(episode, log.measured[episode[0].channel], times)}"
        for episode in stretches[:MOST_EPISODES]
    ]
    output += [f"- and {len(stretches) - MOST_EPISODES} more stretches"] * (len(stretches) > MOST_EPISODES)
    if alarms.without is not None:
        counts = ", ".join(
            f"{channel.symbol} {count}" for channel, count in zip(log.measured, alarms.without, strict=True)
        )
        index = alarms.at_fault
        fault = "no single channel is at fault" if index is None else f"{log.measured[index].symbol} is at fault"
        output.append(f"Remaining alarms without each channel: {counts}: {fault}.")
    return output


def _alarms_as_json(estimates: LogEstimate, watched: LogAlarms | None) -> dict[str, Any]:
    if watched is None:
        return {}
    measured = estimates.log.measured
    alarms = [{**alarm._asdict(), "channel": measured[alarm.channel].symbol} for alarm in watched.alarms]
    left = watched.without and {channel.symbol: n for channel, n in zip(measured, watched.without, strict=True)}
    fault = None if watched.at_fault is None else measured[watched.at_fault].symbol
    return {"monitor": watched.monitor.as_mapping(), "alarms": alarms, "left_without": left, "at_fault": fault}


def _row(residual: Residual) -> list[str]:
    return [residual.quantity.short_label, f"{residual.rmse:.4g}", f"{residual.bias:+.4g}", str(residual.rows)]


def _as_json(estimates: LogEstimate, assessment: LogFindings) -> dict:
    log, white = estimates.log, assessment.whiteness
    return {
        "log": log.name,
        "digest": log.digest,
        "dt": log.dt,
        "rows": log.steps + 1,
        "irregular": log.irregular,
        "grid": log.stamps is None,
        "filter": estimates.filter.name,
        "smoothed": estimates.smoothed,
        "first_row": assessment.first,
        "mean_nis": assessment.mean_nis,
        "nis_band": assessment.nis_band,
        "whiteness_p_value": None if white is None else white.p_value,
        "log_likelihood": assessment.log_likelihood,
        "divergences": estimates.divergences,
        "restarts": estimates.restarts and estimates.restarts._asdict(),
        "one_step_ahead": {residual.quantity.symbol: residual._asdict() for residual in assessment.predictions},
        "references": {residual.quantity.symbol: residual._asdict() for residual in assessment.references},
        "findings": [asdict(finding) for finding in log.findings],
        "sentences": verdict(estimates, assessment),
    }
