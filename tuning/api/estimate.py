"""`tuning.estimate` and `thruster estimate`: a filter or a smoother over a recorded run."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import copy
from dataclasses import asdict, dataclass, replace
from inspect import signature
from math import isnan
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from filters.filter import Filter
from filters.logs.estimate import LogEstimate
from filters.logs.estimate import estimate as estimate_log
from filters.logs.findings import (
    ALPHA,
    LogAlarms,
    LogFindings,
    Residual,
    alarms_of,
    columns_of,
    draw_log,
    episodes,
    findings,
    verdict,
)
from filters.monitoring import Alarm, Monitor, monitor_of, tuned_monitor
from thruster_env.core.checks import short_repr
from thruster_env.core.files import save_figure
from thruster_env.core.text_tables import Table
from thruster_env.logs.log import Log
from thruster_env.logs.times import date_text, time_text
from thruster_env.logs.write import check_picture, check_suffix, write_columns
from thruster_env.model.quantities import Quantity
from tuning.api.markers import (
    FILTER,
    OUTPUT,
    READ,
    WRITTEN,
    FilterOption,
    LogsArgument,
    Option,
    Seed,
    TunedArgument,
    WrittenFile,
)
from tuning.api.read_logs import read_logs, recorded_runs
from tuning.api.result import Result, drawn, frame, number, plain_data
from tuning.logs.read import as_tuned

if TYPE_CHECKING:
    import pandas
    from matplotlib.figure import Figure

    from tuning.api.study import Study

MOST_EPISODES = 8  # of alarms in words
OF_FILE = "tuned"  # the monitor of the tuned file


def episode_sentence(episode: Sequence[Alarm], channel: Quantity, times: np.ndarray) -> str:
    """An episode: "thrust: a bias of +0.32 N since 12.5 s, found at 14.1 s (cusum)".

    It describes the first alarm, or a stuck or missing sensor, which explains the others.
    """
    cause = next((alarm for alarm in episode if alarm.test in ("stuck", "missing")), episode[0])
    unit = f" {channel.unit}" if channel.unit else ""
    what = {
        "outlier": f"an outlier {cause.size:+.3g}{unit} off",
        "variance": f"noise with {cause.size:.2g} times the expected variance",
        "stuck": "equal readings",
        "missing": "no readings",
    }.get(cause.test, f"a bias of {cause.size:+.3g}{unit}")
    dt = float(np.median(np.diff(times)))
    at = [time_text(times[step], dt, 5) for step in (cause.since, cause.step, episode[-1].step)]
    since = "" if cause.test == "outlier" else f" since {at[0]} s, found"
    sentence = f"{channel.symbol}: {what}{since} at {at[1]} s{date_text(times[cause.step])} ({cause.test})"
    tests = list(dict.fromkeys(alarm.test for alarm in episode if alarm is not cause))
    if not tests:
        return sentence
    more = len(episode) - 1
    return f"{sentence}; {more} more alarm{'s' * (more > 1)} until {at[2]} s ({', '.join(tests)})"


@dataclass(frozen=True, eq=False, repr=False)
class LogEstimates(Result):
    """Estimates and innovations of every row of a log, and the findings on filter and model.

    Attributes:
        found: the estimate itself.
        findings: mean NIS with its 95 % band, whiteness, RMSE of predictions, errors against references.
        watched: alarms of the monitor, if one was asked for.
        files: that were written.
    """

    found: LogEstimate
    findings: LogFindings
    watched: LogAlarms | None = None
    files: tuple[str, ...] = ()

    @property
    def log(self) -> Log:
        """The log."""
        return self.found.log

    @property
    def filter(self) -> Filter:
        """The filter."""
        return self.found.filter

    @property
    def means(self) -> np.ndarray:
        """Estimates of the states, (K + 1, n); the smoother's if requested."""
        return self.found.means

    @property
    def stds(self) -> np.ndarray:
        """Their standard deviations, (K + 1, n)."""
        return self.found.stds

    @property
    def innovations(self) -> np.ndarray:
        """Measurement minus prediction, (K + 1, m), NaN if missing."""
        return self.found.innovations

    @property
    def log_likelihood(self) -> float:
        """Of the scored rows; NaN for a filter without a covariance."""
        return self.findings.log_likelihood

    def sentences(self) -> list[str]:
        """Findings in the log, and what the innovations say about filter and model."""
        return verdict(self.found, self.findings)

    def alarms(self, monitor: Monitor | Mapping | float = 100_000.0, *, isolate: bool = False) -> LogAlarms:
        """Tests of the sensors by the innovations (docs/monitoring.md).

        Args:
            monitor: a `filters.monitoring.Monitor`, a mapping of its attributes, or steps between false alarms.
            isolate: whether to run the filter also without each channel, and name the faulty one.

        Raises:
            ValueError: for a wrong monitor, a filter without a covariance, or isolation of the only channel.
        """
        return alarms_of(self.found, monitor_of(monitor) or Monitor(), self.findings.first, isolate=isolate)

    def output(self, symbol: str) -> tuple[np.ndarray, np.ndarray]:
        """An output of the model, such as "T", at the estimates, (K + 1,), and its standard deviation."""
        return self.found.output(symbol)

    def to_frame(self) -> pandas.DataFrame:
        """A row for each time: inputs, measurements, references, estimates, standard deviations and innovations.

        Raises:
            ValueError: if pandas is not installed.
        """
        return frame(dict(columns_of(self.found)), "time_s")

    def save(self, path: str | Path) -> Path:
        """Write the same columns to a .csv, .parquet or .npz file; return the path.

        Raises:
            ValueError: for another ending, or if the file cannot be written.
        """
        write_columns(path, columns_of(self.found), again=True)
        return Path(path)

    def plot_states(self) -> Figure:
        """Estimates of states and outputs over time beside the references, and the innovations below."""
        from filters.logs.findings import draw_log

        return drawn(draw_log(self.found, f"{self._what} on {Path(self.log.name).name}"))

    def plot_innovations(self) -> Figure:
        """Innovations of each channel over time, in the 95 % band that the filter expects."""
        from filters.logs.findings import draw_log

        return drawn(draw_log(self.found, f"{self.filter.name} on {Path(self.log.name).name}", states=False))

    @property
    def _what(self) -> str:
        return f"{self.filter.name}, smoothed," if self.found.smoothed else self.filter.name

    def tables(self) -> list[Table | str]:
        """Innovations, predictions and references, the findings, the alarms and the files, for a terminal."""
        log, result = self.log, self.findings
        how = ", on its own stamps" if log.stamps is not None else ", put on a grid" if log.irregular else ""
        about = f"{log.steps + 1} rows, dt {log.dt:g} s{how}"
        title = f"{self._what} on {log.name} ({about}); scored: rows {result.first} to {log.steps}"
        rows = [["restarts", str(self.found.divergences), "0"]]
        if not isnan(result.mean_nis):
            rows.insert(0, ["log-likelihood", f"{result.log_likelihood:.6g}", ""])
            if result.whiteness is not None:
                rows.insert(0, ["whiteness, p-value", f"{result.whiteness.p_value:.3g}", f"above {ALPHA:g}"])
            band = " to ".join(f"{end:.3g}" for end in result.nis_band)
            rows.insert(0, ["mean NIS over channels", f"{result.mean_nis:.3g}", band])
        parts: list[Table | str] = [Table(title, ["innovations", "", "if consistent"], rows)]
        what = "Smoother" if self.found.smoothed else "Estimate"
        for caption, residuals in (
            ("One-step prediction less measurement", result.predictions),
            (f"{what} less reference, not seen", result.references),
        ):
            if residuals or residuals is result.predictions:
                parts.append(Table(caption, ["", "RMSE", "bias", "rows"], list(map(_cells, residuals))))
        return [*parts, *self.sentences(), *self._alarm_sentences(), *(f"wrote {path}" for path in self.files)]

    def _alarm_sentences(self) -> list[str]:
        log, alarms = self.log, self.watched
        if alarms is None:
            return []
        times, rows = log.start + log.times, log.steps + 1 - alarms.first
        expected = rows / alarms.monitor.steps_between
        what = f"{rows} rows, {expected:.2g} false alarms expected if the model is right"
        if not alarms.alarms:
            return [f"No alarm in {what}."]
        stretches = episodes(alarms.alarms, alarms.monitor.memory)
        lines = [f"Alarms: {len(alarms.alarms)} in {what}."]
        for episode in stretches[:MOST_EPISODES]:
            lines.append(f"- {episode_sentence(episode, log.measured[episode[0].channel], times)}")
        lines += [f"- and {len(stretches) - MOST_EPISODES} more stretches"] * (len(stretches) > MOST_EPISODES)
        if alarms.without is not None:
            pairs = zip(log.measured, alarms.without, strict=True)
            counts = ", ".join(f"{channel.symbol} {count}" for channel, count in pairs)
            index = alarms.at_fault
            fault = "no single channel is" if index is None else f"{log.measured[index].symbol} is"
            lines.append(f"Remaining alarms without each channel: {counts}: {fault} at fault.")
        return lines

    def figures(self) -> dict[str, Figure]:
        """States and innovations over time."""
        return {"Estimates, references and innovations": self.plot_states()}

    def as_dict(self) -> dict[str, Any]:
        """All results as plain data, as in `thruster estimate --json`."""
        log, result, white = self.log, self.findings, self.findings.whiteness
        data = {
            "log": log.name,
            "digest": log.digest,
            "dt": log.dt,
            "rows": log.steps + 1,
            "irregular": log.irregular,
            "grid": log.stamps is None,
            "filter": self.filter.name,
            "smoothed": self.found.smoothed,
            "first_row": result.first,
            "mean_nis": result.mean_nis,
            "nis_band": result.nis_band,
            "whiteness_p_value": None if white is None else white.p_value,
            "log_likelihood": result.log_likelihood,
            "divergences": self.found.divergences,
            "restarts": self.found.restarts and self.found.restarts._asdict(),
            "one_step_ahead": {residual.quantity.symbol: residual._asdict() for residual in result.predictions},
            "references": {residual.quantity.symbol: residual._asdict() for residual in result.references},
            "findings": [asdict(finding) for finding in log.findings],
            "sentences": self.sentences(),
        }
        return plain_data({**data, **self._alarms_as_dict(), "files": list(self.files)})

    def _alarms_as_dict(self) -> dict[str, Any]:
        watched, names = self.watched, [channel.symbol for channel in self.log.measured]
        if watched is None:
            return {}
        alarms = [{**alarm._asdict(), "channel": names[alarm.channel]} for alarm in watched.alarms]
        left = watched.without and dict(zip(names, watched.without, strict=True))
        fault = None if watched.at_fault is None else names[watched.at_fault]
        return {"monitor": watched.monitor.as_mapping(), "alarms": alarms, "left_without": left, "at_fault": fault}

    def __repr__(self) -> str:
        rows, findings, what = self.log.steps + 1, self.findings, f"{self._what} on {self.log.name}"
        if isnan(findings.mean_nis):
            return f"LogEstimates({what}: {rows} rows)"
        low, high = findings.nis_band
        nis = f"mean NIS over channels {findings.mean_nis:.3g}, {low:.3g} to {high:.3g} if consistent"
        return f"LogEstimates({what}: {rows} rows; {nis}; log-likelihood {number(findings.log_likelihood)})"


def _cells(residual: Residual) -> list[str]:
    return [residual.quantity.short_label, f"{residual.rmse:.4g}", f"{residual.bias:+.4g}", str(residual.rows)]


def estimate(
    log: Annotated[Any, LogsArgument(metavar="LOG", type=Path, file=READ, last="stamps")],
    tuned: Annotated[str | Path | Study | None, TunedArgument] = None,
    *,
    filter: Annotated[Any, FilterOption] = None,
    ensemble_size: Annotated[int | None, Option(FILTER)] = None,
    smoother: Annotated[bool, Option(FILTER)] = False,
    lag: Annotated[int | None, Option(FILTER)] = None,
    skip: int | None = None,
    monitor: Annotated[Monitor | Mapping | float | str | None, Option(metavar="STEPS", type=str)] = None,
    isolate: bool = False,
    out: Annotated[str | Path | None, Option(OUTPUT, type=Path, file=WRITTEN)] = None,
    plot: WrittenFile = None,
    seed: Seed = 0,
    **numbers: Any,
) -> LogEstimates:
    """Estimate the state of a recorded run, and report what the innovations say about filter and model.

    The log has the model's inputs and measurements, found by the headers of its columns or given by --column.
    States or outputs of the model in the log, such as the thrust of a load cell that the filter does not see, are
    compared with the estimate. docs/logs.md has the rules.

        estimates = tuning.estimate("run.csv", "tuned.json")
        estimates.to_frame()
        estimates.plot_states()

    Example: thruster estimate run.csv tuned.json --out est.csv --plot est.png

    Example: thruster estimate run.csv --sensor speed --column speed=motor_rpm --column thrust=loadcell[kgf]

    Args:
        log: recorded run. In Python as `tuning.read_logs` reads it, a file or table of a thruster, or a pair
            (model, log).
        tuned: tuned file, with filter, Q and R. In Python also a `Study`.
        filter: without a tuned file, the name of a filter, as `thruster filters` lists them; ekf by default. In
            Python also another package's estimator.
        ensemble_size: ensemble size; 100 by default, 1000 for particles.
        smoother: also use later measurements.
        lag: smoother with that many later measurements; all by default.
        skip: number of initial rows that are not scored; 50, or a quarter of a short log, by default.
        monitor: test for outliers, biases, changed noise, stuck and missing readings, with one false alarm in this
            number of steps, or "tuned" for the tuned file's monitor (docs/monitoring.md). In Python also a
            `Monitor` or a mapping of its attributes.
        isolate: also run the filter without each channel, and name the faulty one.
        out: estimates, bands and innovations as .csv, .parquet or .npz.
        plot: picture of everything over time, .png, .svg or .pdf.
        seed: seed of all randomness; the same seed gives the same results.
        **numbers: further parameters of the filter.

    Returns:
        `LogEstimates`: `means`, `stds`, `findings`, `to_frame()`, `plot_states()`, `plot_innovations()`, `save()`.

    Raises:
        ValueError: states the rule and the value.
    """
    for name in numbers.keys() & signature(read_logs).parameters.keys():
        raise ValueError(f"{name} must be given to tuning.read_logs, whose runs estimate takes, not to estimate")
    runs = recorded_runs(log)
    if isinstance(runs.files, str | Path) and str(runs.files).endswith(".json") and tuned is not None:
        runs, tuned = replace(runs, files=tuned), runs.files  # the other way round
    if tuned is not None and filter is not None:
        raise ValueError(
            "give either a tuned file or a filter (--filter NAME), but got both, "
            f"{short_repr(tuned)} and {short_repr(filter)}"
        )
    if plot is not None:
        check_picture(plot, "--plot")
    if out is not None:
        check_suffix(out)
    numbers |= {} if ensemble_size is None else {"ensemble_size": ensemble_size}
    with _as_file(tuned) as file:
        watch = monitor_for(monitor, file)
        if isolate and watch is None:
            raise ValueError(
                "isolate (--isolate) must come with monitor (--monitor STEPS), whose alarms it counts"
            )
        runs = replace(runs, reading=as_tuned(runs.reading, file))
        recorded, offer = runs.read(is_tuned=file is not None)
        result = estimate_log(
            recorded, filter, offer, tuned=file, smoother=smoother, lag=lag, seed=seed, **numbers
        )
    estimates = LogEstimates(result, findings(result, skip))
    if watch is not None:
        estimates = replace(estimates, watched=estimates.alarms(watch, isolate=isolate))
    if out is not None:
        write_columns(out, columns_of(result, estimates.watched), again=True)
    if plot is not None:
        title = f"{estimates._what} on {recorded.name}"
        save_figure(draw_log(result, title, alarms=estimates.watched), Path(plot))
    return replace(estimates, files=tuple(str(path) for path in (out, plot) if path is not None))


def monitor_for(argument: Monitor | Mapping | float | str | None, tuned: str | Path | None) -> Monitor | None:
    """The monitor for an argument: one, its attributes, steps between false alarms, or "tuned", the file's."""
    if argument != OF_FILE:
        try:
            return monitor_of(float(argument) if isinstance(argument, str) else argument)
        except ValueError as error:
            rule = f"monitor (--monitor) must be steps, or {OF_FILE!r}"
            raise ValueError(f"{rule}, but got {argument}: {error}") from None
    if tuned is None:
        raise ValueError(f"monitor (--monitor) {OF_FILE} must come with a tuned file, but got none")
    return tuned_monitor(tuned)


@contextmanager
def _as_file(tuned: Any) -> Iterator[str | Path | None]:
    """A tuned file, of a study one that is gone afterwards."""
    if tuned is None or isinstance(tuned, str | Path):
        yield tuned
        return
    if not hasattr(tuned, "save"):
        raise ValueError(f"tuned must be a tuned file or a Study, but got {short_repr(tuned)}")
    with tempfile.TemporaryDirectory() as folder:
        yield copy(tuned).save(Path(folder) / "tuned.json")  # the study itself does not remember this one
