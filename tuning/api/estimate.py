"""`tuning.estimate`: a filter or a smoother over a recorded run."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass
from math import isnan
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from filters.filter import Filter
from filters.logs.estimate import LogEstimate
from filters.logs.estimate import estimate as estimate_log
from filters.logs.findings import LogAlarms, LogFindings, alarms_of, columns_of, findings, verdict
from filters.monitoring.monitor import Monitor, monitor_of
from thruster_env.core.checks import short_repr
from thruster_env.logs.log import Log
from thruster_env.logs.write import write_columns
from tuning.api.progress import drawn, frame, html, number
from tuning.logs.problem import name_of
from tuning.logs.read import as_tuned, model_of_logs, read_named

# `LogEstimates`: the estimates of a filter or a smoother on a recorded run, as a value.


if TYPE_CHECKING:
    import pandas
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False, repr=False)
class LogEstimates:
    """Estimates and innovations of every row of a log, and the findings on filter and model.

    Attributes:
        found: the estimate itself.
        findings: mean NIS with its 95 % band, whiteness, RMSE of predictions, errors against references.
    """

    found: LogEstimate
    findings: LogFindings

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

        smoothed = ", smoothed," if self.found.smoothed else ""
        return drawn(draw_log(self.found, f"{self.filter.name}{smoothed} on {Path(self.log.name).name}"))

    def plot_innovations(self) -> Figure:
        """Innovations of each channel over time, in the 95 % band that the filter expects."""
        from filters.logs.findings import draw_log

        return drawn(draw_log(self.found, f"{self.filter.name} on {Path(self.log.name).name}", states=False))

    def __repr__(self) -> str:
        what = f"{self.filter.name}{', smoothed,' if self.found.smoothed else ''} on {self.log.name}"
        rows, findings = self.log.steps + 1, self.findings
        if isnan(findings.mean_nis):
            return f"LogEstimates({what}: {rows} rows)"
        low, high = findings.nis_band
        nis = f"mean NIS over channels {findings.mean_nis:.3g}, {low:.3g} to {high:.3g} if consistent"
        return f"LogEstimates({what}: {rows} rows; {nis}; log-likelihood {number(findings.log_likelihood)})"

    def _repr_html_(self) -> str:
        findings, rows = self.findings, []
        for what, residuals in (
            ("prediction less measurement", findings.predictions),
            ("less reference", findings.references),
        ):
            for residual in residuals:
                errors = f"{residual.rmse:.4g}", f"{residual.bias:+.4g}"
                rows.append([what, residual.quantity.short_label, *errors, residual.rows])
        return html(repr(self), ["", "quantity", "RMSE", "bias", "rows"], rows, " ".join(self.sentences()))


if TYPE_CHECKING:
    from tuning.api.study import Study


def estimate(
    log: Any,
    tuned: str | Path | Study | None = None,
    *,
    filter: Any = None,
    model: Any = None,
    preset: str | Path | None = None,
    sensors: Sequence[str] | None = None,
    columns: Any = None,
    clock_offset: Any = None,
    dt: float | None = None,
    grid: bool = True,
    stamps: str | None = None,
    smoother: bool = False,
    lag: int | None = None,
    skip: int | None = None,
    seed: int = 0,
    **numbers: Any,
) -> LogEstimates:
    """Estimate the state of a recorded run, and report what the innovations say about filter and model.

    States or outputs of the model in the log, such as the thrust of a load cell that the filter does not see, are
    compared with the estimate.

        estimates = tuning.estimate("run.csv", tuned="tuned.json")
        estimates.to_frame()
        estimates.plot_states()

    Args:
        log: the path of a .csv, .parquet or .npz file, or of a recorder's; a table, as a pandas.DataFrame or a
            mapping from headers to arrays; or a `Log`; or a pair (model, log).
        tuned: a tuned file or a `Study`, with filter, Q, R and other parameters.
        filter: without these, the name of a filter, or another package's estimator; "ekf" if None.
        model: the log's model, if it is not a thruster's: a `StateSpaceModel`, an object that makes or offers one,
            "module:object", or a thruster's preset.
        preset: the log's thruster, by name or file.
        sensors: a thruster's channels that the filter sees.
        columns: headers by quantity: {"speed": "motor_rpm", "thrust": "loadcell[kgf]"}.
        clock_offset: seconds by quantity that a channel's clock is ahead.
        dt: sample time [s] of a log without times, or of the grid.
        grid: whether to put the log on a grid; otherwise the filter uses its own time stamps.
        stamps: of a bag, "header" or "receipt": the clock of all topics.
        smoother: correct estimates by later measurements.
        lag: number of later measurements, also without `smoother`; all by default.
        skip: initial rows that are not scored; 50, or a quarter of a short log, by default.
        seed: of the filter's random numbers.
        **numbers: the filter's own, such as `ensemble_size`.

    Returns:
        `LogEstimates`: `means`, `stds`, `findings`, `to_frame()`, `plot_states()`, `plot_innovations()`, `save()`.

    Raises:
        ValueError: states the rule and the value.
    """
    if tuned is not None and filter is not None:
        raise ValueError(
            f"give either a tuned file or a filter, but got both, {short_repr(tuned)} and {short_repr(filter)}"
        )
    log, model, preset = model_of_logs(log, model, preset)
    named = {"preset": preset, "model": model, "sensors": sensors, "columns": columns, "stamps": stamps}
    with _as_file(tuned) as file:
        named = as_tuned(named, file)
        read, offer = read_named(log, **named, clock_offset=clock_offset, dt=dt, name=name_of(log, 0), grid=grid)
        estimates = estimate_log(read, filter, offer, tuned=file, smoother=smoother, lag=lag, seed=seed, **numbers)
    return LogEstimates(estimates, findings(estimates, skip))


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
