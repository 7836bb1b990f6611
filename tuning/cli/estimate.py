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
from tuning.cli.log_options import GridOptions, with_groups
from tuning.cli.options import (
    A_LOG,
    FILTER,
    FILTER_HELP,
    OUTPUT,
    RUNS,
    JsonOption,
    MonitorOption,
    SeedOption,
    asked_monitor,
    filter_option,
    one_file,
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
    found = estimate(recorded, filter_name, offer, **options)
    told = findings(found, skip)
    alarms = None if watch is None else alarms_of(found, watch, told.first, isolate=isolate)
    if out is not None:
        write_columns(out, columns_of(found, alarms), again=True)
    if plot is not None:
        from filters.logs.figure import log_figure

        log_figure(plot, found, f"{_title(found)} on {log.name}", alarms)
    files = [str(path) for path in (out, plot) if path is not None]
    shown = [*_report(found, told), *_alarms(found, alarms), *[f"wrote {path}" for path in files]]
    emit(shown, {**_as_json(found, told), **_alarms_as_json(found, alarms), "files": files}, json)


def _title(found: LogEstimate) -> str:
    return f"{found.filter.name}, smoothed," if found.smoothed else found.filter.name


def _report(found: LogEstimate, told: LogFindings) -> list[RenderableType]:
    log = found.log
    how = ", on its own stamps" if log.stamps is not None else ", put on a grid" if log.irregular else ""
    about = f"{log.steps + 1} rows, dt {log.dt:g} s{how}"
    title = f"{_title(found)} on {log.name} ({about}); scored: rows {told.first} to {log.steps}"
    rows = [
        ["mean NIS over channels", f"{told.mean_nis:.3g}", f"{told.nis_band[0]:.3g} to {told.nis_band[1]:.3g}"],
        ["log-likelihood", f"{told.log_likelihood:.6g}", ""],
        ["restarts", str(found.divergences), "0"],
    ]
    if isnan(told.mean_nis):
        rows = rows[2:]
    elif told.whiteness is not None:
        white = told.whiteness
        rows.insert(1, ["whiteness, p-value", f"{white.p_value:.3g}", f"above {ALPHA:g}"])
    shown: list[RenderableType] = [table(title, ["innovations", "", "if consistent"], rows)]
    columns = ["", "RMSE", "bias", "rows"]
    shown.append(table("One-step prediction less measurement", columns, list(map(_row, told.predictions))))
    if told.references:
        what = "Smoother" if found.smoothed else "Estimate"
        shown.append(table(f"{what} less reference, not seen", columns, list(map(_row, told.references))))
    return shown + verdict(found, told)


def _alarms(found: LogEstimate, told: LogAlarms | None) -> list[RenderableType]:
    """The first alarms in words, and the channel at fault."""
    if told is None:
        return []
    log, times = found.log, found.log.start + found.log.times
    rows, expected = log.steps + 1 - told.first, (log.steps + 1 - told.first) / told.monitor.steps_between
    what = f"{rows} rows, {expected:.2g} false alarms expected if the model is right"
    if not told.alarms:
        return [f"No alarm in {what}."]
    some = episodes(told.alarms, told.monitor.memory)
    shown: list[RenderableType] = [f"Alarms: {len(told.alarms)} in {what}."]
    shown += [f"- {episode_sentence(one, log.measured[one[0].channel], times)}" for one in some[:MOST_EPISODES]]
    shown += [f"- and {len(some) - MOST_EPISODES} more stretches"] * (len(some) > MOST_EPISODES)
    if told.without is not None:
        counts = ", ".join(f"{one.symbol} {count}" for one, count in zip(log.measured, told.without, strict=True))
        place = told.at_fault
        fault = "no single channel is at fault" if place is None else f"{log.measured[place].symbol} is at fault"
        shown.append(f"Remaining alarms without each channel: {counts}: {fault}.")
    return shown


def _alarms_as_json(found: LogEstimate, told: LogAlarms | None) -> dict[str, Any]:
    if told is None:
        return {}
    measured = found.log.measured
    alarms = [{**one._asdict(), "channel": measured[one.channel].symbol} for one in told.alarms]
    left = told.without and {one.symbol: n for one, n in zip(measured, told.without, strict=True)}
    fault = None if told.at_fault is None else measured[told.at_fault].symbol
    return {"monitor": told.monitor.as_mapping(), "alarms": alarms, "left_without": left, "at_fault": fault}


def _row(one: Residual) -> list[str]:
    return [one.quantity.short_label, f"{one.rmse:.4g}", f"{one.bias:+.4g}", str(one.rows)]


def _as_json(found: LogEstimate, told: LogFindings) -> dict:
    log, white = found.log, told.whiteness
    return {
        "log": log.name,
        "digest": log.digest,
        "dt": log.dt,
        "rows": log.steps + 1,
        "irregular": log.irregular,
        "grid": log.stamps is None,
        "filter": found.filter.name,
        "smoothed": found.smoothed,
        "first_row": told.first,
        "mean_nis": told.mean_nis,
        "nis_band": told.nis_band,
        "whiteness_p_value": None if white is None else white.p_value,
        "log_likelihood": told.log_likelihood,
        "divergences": found.divergences,
        "restarts": found.restarts and found.restarts._asdict(),
        "one_step_ahead": {one.quantity.symbol: one._asdict() for one in told.predictions},
        "references": {one.quantity.symbol: one._asdict() for one in told.references},
        "findings": [asdict(one) for one in log.findings],
        "sentences": verdict(found, told),
    }
