"""`filters.run` and `smooth`: plain arrays and tables in, steps of any length; tables and pictures out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from filters.engine import batch
from filters.engine.batch import Estimates, Prepared, prepared
from filters.filter import Filter
from filters.smoothers import Smoothed, smoothed_rows
from filters.starts import warn_of_restarts
from thruster_env.core.checks import FEW, at_least
from thruster_env.core.modules import to_install
from thruster_env.logs.log import Log
from thruster_env.model.continuous import same_dt
from thruster_env.model.turns import readings, stored_covs

if TYPE_CHECKING:
    import pandas
    from matplotlib.figure import Figure

    from filters.logs.estimate import LogEstimate


class WithTables:
    """Tables and pictures of estimates that know their filter and data."""

    is_smoothed: ClassVar[bool] = False
    data: Prepared
    means: np.ndarray
    covs: np.ndarray

    @property
    def _filtered(self) -> Estimates:
        """The filter's estimates, whose innovations are drawn."""
        raise NotImplementedError

    def to_frame(self, run: int | None = None) -> pandas.DataFrame:
        """A table by time: inputs, measurements, estimates with standard deviations, and innovations, with units.

        Args:
            run: number of the trajectory in a batch; all, by run and time, if None.

        Raises:
            ValueError: if pandas is not installed, or for an unknown number.
        """
        from filters.logs.findings import columns_of

        try:
            import pandas
        except ImportError:
            raise ValueError(
                f"to_frame must have pandas, which is not installed: {to_install('frames')}"
            ) from None
        count = len(self.data.keys)
        if run is None and count > 1:
            return pandas.concat({number: self.to_frame(number) for number in range(count)}, names=["run"])
        return pandas.DataFrame(columns_of(self._of_log(run or 0))).set_index("time_s")

    def plot(self, run: int = 0) -> Figure:
        """States and innovations of one trajectory over time, each in its 95 % band; of a batch the first one."""
        from filters.logs.findings import draw_log

        count, title = len(self.data.keys), self.data.filter.name
        return draw_log(self._of_log(run), f"{title}, run {run} of 0 to {count - 1}" if count > 1 else title)

    def _of_log(self, run: int) -> LogEstimate:
        """A trajectory as the estimate of a log."""
        from filters.logs.estimate import LogEstimate

        data, model = self.data, self.data.filter.model
        run = at_least("run", run, 0, len(data.keys) - 1)
        steps, z = np.diff(data.times) if len(data.times) > 1 else np.ones(1), data.measurements[run, data.rows]
        stamps = None if same_dt(float(steps.min()), float(steps.max())) else data.times - data.times[0]
        plain = getattr(model, "plain", model)
        inputs = data.inputs[run][data.rows[1:] - 1, : plain.inputs]
        log = Log(
            "run", float(np.median(steps)), inputs, z, plain.input_quantities, plain.measurements, stamps=stamps
        )
        log = replace(log, start=float(data.times[0]))
        filtered = self._filtered
        means, covs, innovations, innovation_covs, likelihoods = (
            part if data.is_single else part[run] for part in (self.means, self.covs, *filtered[2:5])
        )
        filter_ = data.filter if plain is model else replace(data.filter, model=plain)
        return LogEstimate(
            log,
            filter_,
            means,
            stored_covs(means, covs, plain.turns),
            np.where(np.isnan(readings(z, plain.measured_turns)), np.nan, innovations),
            innovation_covs,
            likelihoods,
            int(np.max(filtered.divergences)),
            smoothed=self.is_smoothed,
        )


class FilteredRuns(WithTables, Estimates):
    """`Estimates` that know their filter and data, for tables and pictures."""

    @property
    def _filtered(self) -> Estimates:
        return self

    def __repr__(self) -> str:
        if not hasattr(self, "data"):  # as after `_replace`
            return super().__repr__()
        data, (n, t) = self.data, (self.means.shape[-1], self.covs.shape[-1])
        count, rows = len(data.keys), len(data.rows)
        names = [quantity.label for quantity in data.filter.model.states] if count == 1 and n == t else []
        last = self.means.reshape(count, rows, n)[0, -1], self.stds.reshape(count, rows, t)[0, -1]
        of = f"{count} trajectories of {rows} rows each" if count > 1 else f"{rows} rows"
        lines = [f"Estimates of {data.filter.name}: {of}, {data.times[0]:g} to {data.times[-1]:g} s"]
        lines += [f"  last {name} {m:.6g} +- {s:.3g}" for name, m, s in [*zip(names, *last, strict=False)][:FEW]]
        lines[1:] += ["  ..."] * (len(names) > FEW)
        total, restarts = float(np.sum(self.log_likelihoods)), int(np.sum(self.divergences))
        lines.append(f"log-likelihood {total:.6g}" + f", {restarts} restarts" * (restarts > 0))
        each = "to_frame() has all, plot(run=0) one" if count > 1 else "to_frame(), plot()"
        lines.append(f".means {self.means.shape}, .stds, .covs, .innovations, .log_likelihoods; {each}")
        return "\n".join(lines)


class SmoothedRuns(WithTables, Smoothed):
    """`Smoothed` that know their filter and data; innovations of tables and pictures are the filter's."""

    is_smoothed: ClassVar[bool] = True

    @property
    def stds(self) -> np.ndarray:
        """Standard deviations of the errors, (B, K + 1, n)."""
        return np.sqrt(np.diagonal(self.covs, axis1=-2, axis2=-1))

    @cached_property
    def _filtered(self) -> Estimates:
        data = self.data
        estimates = batch.run(data.filter, data.keys, data.inputs, data.measurements, **data.noise)
        parts = [*(part[:, data.rows] for part in estimates[:5]), estimates.divergences]
        return Estimates(*(part[0] for part in parts) if data.is_single else parts)


def run(
    filter_: Filter,
    keys: Any = None,
    inputs: Any = None,
    measurements: Any = None,
    *,
    dt: Any = None,
    noise: Callable[[float], Any] | None = None,
    update_first: bool = True,
    process_noise_covs: np.ndarray | None = None,
    measurement_noise_covs: np.ndarray | None = None,
) -> FilteredRuns:
    """Filter one trajectory or many in one compiled call that uses all cores.

        estimates = filters.run(filter_, z)
        estimates = filters.run(filter_, inputs=u, measurements=z, dt=0.1)
        estimates.means, estimates.stds, estimates.to_frame(), estimates.plot()

    A single trajectory may have the shapes (K + 1,) or (K + 1, m), and (K,) or (K, p), as an array, a list or
    from pandas; its results then have no axis B. An input of the last row moves nothing and is left out, except
    that of `from_filterpy` the first one belongs to the prediction before the first measurement.

    An index of pandas with dates, periods, time differences or increasing floats gives the steps if dt is None.

    The first measurement updates the prior, as in pykalman, statsmodels and MATLAB. With `update_first=False` the
    filter predicts before it, as FilterPy does: then there are as many inputs as measurements, and `dt` begins
    with the step to the first one.

    Args:
        filter_: any filter, or an estimator of another package in its place.
        keys: random keys (B, 2), two whole numbers below 2^32 for each trajectory; those of seeds 0, 1, ..., B - 1
            if None. Filters without random draws ignore them: run(filter_, inputs=u, measurements=z).
        inputs: u, (B, K, p), in the units of the model's inputs; None for a model without inputs. The filter
            predicts step k + 1 with u[:, k], which a measurement h(x, u, c) at its end depends on.
        measurements: z, (B, K + 1, m), in the units of the model's measurements, NaN where missing.
        dt: lengths of the steps [s], one or (K,), the same for all trajectories. Of a model in continuous time
            they may differ; a longer step than the model's is divided. Others must be of equal steps, those of the
            model if it has a `dt`.
        noise: Q (n, n) of a step by its length [s], as `ContinuousModel.noise`; in proportion to it if None.
        update_first: whether the first measurement updates the prior itself.
        process_noise_covs: Q of every step, (K, n, n), in place of the model's.
        measurement_noise_covs: R of every measurement, (K + 1, m, m), in place of the model's.

    Returns:
        `FilteredRuns`: `Estimates` with `to_frame()` and `plot()`, which do not depend on the number of cores; a
        `RestartWarning` if the filter restarted.

    Raises:
        ValueError: if shapes do not fit, an input is not finite, or steps differ for a model or filter of one
            sample time; errors of `ForeignFilter.fill` for estimators.
    """
    covs = process_noise_covs, measurement_noise_covs
    data = prepared(filter_, keys, inputs, measurements, *covs, dt=dt, noise=noise, update_first=update_first)
    arguments = data.keys, data.inputs, data.measurements
    estimates = batch.run(data.filter, *arguments, **data.noise)
    warn_of_restarts(data.filter, estimates.divergences, *arguments, **data.noise)
    parts: Sequence = estimates
    if len(data.rows) < estimates.means.shape[1]:  # else a copy would take as long as the filter
        parts = [*(part[:, data.rows] for part in estimates[:5]), estimates.divergences]
    runs = FilteredRuns(*(part[0] for part in parts) if data.is_single else parts)
    runs.data = data
    return runs


def smooth(
    filter_: Filter,
    keys: np.ndarray | None = None,
    inputs: np.ndarray | None = None,
    measurements: np.ndarray | None = None,
    lag: int | None = None,
    *,
    dt: Any = None,
    noise: Callable[[float], Any] | None = None,
    update_first: bool = True,
    process_noise_covs: np.ndarray | None = None,
    measurement_noise_covs: np.ndarray | None = None,
) -> SmoothedRuns:
    """Filter trajectories forwards and correct the estimates by later measurements.

    - Kalman filters, also scheduled, extended or iterated extended, unscented and cubature Kalman filters: the
      recursion of Rauch, Tung and Striebel backwards, on the filter's own linearisation or sigma points.
    - Filters of several models: `smooth_modes`, which also returns the probabilities of the modes; without a lag.
    - Ensemble Kalman filters of all kinds: the smoother of Evensen and van Leeuwen. Each update moves the members
      of earlier steps, too. Each adds its sampling error, so that a small ensemble gains by a short lag only.

    The recursion backwards, with both covariances given the measurements up to k, is

        G_k = cov(x_k, x_{k+1}) cov(x_{k+1})^-1,   mean_k += G_k (smoothed mean_{k+1} - predicted mean_{k+1}),
        P_k += G_k (smoothed P_{k+1} - predicted P_{k+1}) G_k'

    A single trajectory may have the shapes (K + 1,) or (K + 1, m) and (K,) or (K, p), as `filters.run` takes it.

    The recursion runs without bounds on states, like the filter's; its estimates are constrained at the end, by
    truncation or projection.

    With lag = 0 the result is the filter's own. The full smoother of an ensemble takes K/2 updates per step, so
    give it a lag of the length of the system's memory.

    Args:
        filter_: a filter of one of these types.
        keys: random keys, one a trajectory, (B, 2); those of seeds 0, 1, ..., B - 1 if None.
        inputs: u, (B, K, p), in the units of the model's inputs; None for a model without inputs.
        measurements: z, (B, K + 1, m), in the units of the model's measurements, NaN where missing.
        lag: number of later measurements that each estimate uses (fixed-lag smoothing); all of them if None.
        dt: lengths of the steps [s], as `filters.run` takes them.
        noise: Q by the length of a step [s], likewise.
        update_first: whether the first measurement updates the prior itself, likewise.
        process_noise_covs: Q of every step, (K, n, n), in place of the model's, as `filters.run` takes it.
        measurement_noise_covs: R of every measurement, (K + 1, m, m), likewise.

    Returns:
        `SmoothedRuns`: `Smoothed` with `to_frame()` and `plot()`, which do not depend on the number of cores; a
        `RestartWarning` if the filter restarted.

    Raises:
        ValueError: if shapes do not fit, an input is not finite, or there is no smoother for the filter.

    Source: Rauch, Tung, Striebel (1965), "Maximum likelihood estimates of linear dynamic systems"; Sarkka (2008),
    "Unscented Rauch-Tung-Striebel smoother"; Evensen, van Leeuwen (2000), "An ensemble Kalman smoother for
    nonlinear dynamics"; fixed lag: Anderson, Moore (1979), Optimal Filtering, chapter 7.
    """
    covs = process_noise_covs, measurement_noise_covs
    data = prepared(filter_, keys, inputs, measurements, *covs, dt=dt, noise=noise, update_first=update_first)
    estimates, divergences = smoothed_rows(data, lag)
    warn_of_restarts(data.filter, divergences, data.keys, data.inputs, data.measurements, **data.noise)
    runs = SmoothedRuns(*(part[0] for part in estimates) if data.is_single else estimates)
    runs.data = data
    return runs
