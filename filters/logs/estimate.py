"""A filter, or a smoother, over a log: estimates, bands and innovations of every row."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from filters.engine.batch import Estimates, estimates_of, prepared, run
from filters.engine.session import Session
from filters.estimators.foreign import Estimator, ForeignFilter
from filters.filter import Filter
from filters.live import Live
from filters.smoothers import smoothed_rows
from filters.starts import FirstRestart, Restarts, begun_at, first_measured
from filters.wrappers.arguments import filter_for
from thruster_env.core.angles import difference
from thruster_env.core.checks import at_least
from thruster_env.core.streams import filter_keys
from thruster_env.env.model_env import ReplayEnv
from thruster_env.logs.grid import MOST_HELD
from thruster_env.logs.log import FEWEST_STEPS, Log, piece_of, seen_by
from thruster_env.model.continuous import ContinuousModel
from thruster_env.model.quantities import Quantity
from thruster_env.model.state_space import StateSpaceModel
from thruster_env.model.turns import error_quantities, readings, stored_covs

SKIPPED = 50  # first rows that do not count, in which a filter settles
STEP = 1e-4  # of the slopes of outputs, in standard deviations
LOST = 0.3  # rad, by which a sensor turns in a gap, from which on the rate before it tells nothing of its attitude

# A filter over a log on its own stamps: by the clock, as `filter.live()` goes.


def by_the_clock(
    filter_: Filter, key: np.ndarray, log: Log, noise: Callable[[float], np.ndarray] | None
) -> tuple[Estimates, Restarts | None]:
    """The estimates of a log on its own stamps, in the form of `filters.run`, and the restarts.

    Args:
        filter_: of a model whose sample time is one of its constants.
        key: random key (2,).
        log: on its own stamps.
        noise: Q by the length of a step [s]; None for one in proportion to it.

    Raises:
        ValueError: for a model of one sample time, or another package's estimator.
    """
    if isinstance(filter_, ForeignFilter):
        raise ValueError(f"a log on its own stamps must be for a filter of ours, but got {filter_.name!r}")
    live = Live(filter_, noise=noise, resolution=log.resolution)
    times, z = log.times.tolist(), seen_by(filter_.model, log.measurements)
    live.start(0.0, z[0], key)
    rows = [live.latest()]
    for k, u in enumerate(log.inputs, 1):
        live.predict_to(times[k], u)
        live.update(times[k], None, z[k])
        rows.append(live.latest())
    return estimates_of(rows, live.divergences), live.restarts


def noise_by_rates(
    plant: ContinuousModel | None, model: StateSpaceModel, dt: float
) -> Callable[[float], np.ndarray] | None:
    """Q by the length of a step [s], of a plant in continuous time whose noise at dt is the model's.

    For a model with another Q, as after tuning, it is None: in proportion to the length.
    """
    if plant is None or not np.array_equal(plant.noise(dt), model.process_noise_cov):
        return None
    return plant.noise


class LogEstimate(NamedTuple):
    """Estimates of a filter on a log of K steps; with a smoother, means and covariances are the smoother's."""

    log: Log
    filter: Filter
    means: np.ndarray  # (K + 1, n)
    covs: np.ndarray  # (K + 1, n, n)
    innovations: np.ndarray  # (K + 1, m), of rotations in their tangent; NaN where nothing was measured
    innovation_covs: np.ndarray  # (K + 1, m, m)
    log_likelihoods: np.ndarray  # (K + 1,), NaN for filters without a covariance
    divergences: int  # restarts from the prior
    smoothed: bool
    noise: Callable[[float], np.ndarray] | None = None  # Q by the length of a step [s], on a log's own stamps
    restarts: Restarts | None = None  # the first one, and why; None if there is none

    @property
    def model(self) -> StateSpaceModel:
        """The filter's model."""
        return self.filter.model

    @property
    def innovation_quantities(self) -> list[Quantity]:
        """The quantities of the m innovations: s_1, s_2, s_3 [rad] of a measured rotation s_w ... s_z."""
        return error_quantities(self.log.measured, self.model.measured_turns)

    @property
    def stds(self) -> np.ndarray:
        """Standard deviations of the states, (K + 1, n); zero for filters without a covariance."""
        return np.sqrt(np.maximum(np.einsum("kii->ki", self.covs), 0.0))

    def output(self, symbol: str) -> tuple[np.ndarray, np.ndarray]:
        """An output of the model at the estimates, (K + 1,), and its standard deviation, linearised."""
        stds, here = self.stds, self.model.output(symbol, self.means)
        angle = self.model.outputs[symbol].quantity.angle
        slopes = np.zeros_like(self.means)
        for i in range(self.means.shape[1]):
            step = np.zeros_like(self.means)
            step[:, i] = np.where(stds[:, i] > 0, STEP * stds[:, i], 1.0)
            ends = [self.model.output(symbol, self.means + sign * step) for sign in (1, -1)]
            slopes[:, i] = difference(ends[0][:, None], ends[1][:, None], (angle,))[:, 0] / (2 * step[:, i])
        return here, np.sqrt(np.maximum(np.einsum("ki,kij,kj->k", slopes, self.covs, slopes), 0.0))


def estimate(
    log: Log | str | Path,
    filter: str | Estimator | Callable | None = None,
    model=None,
    *,
    tuned: str | Path | None = None,
    smoother: bool = False,
    lag: int | None = None,
    columns: Mapping[str, str] | None = None,
    clock_offset: Mapping[str, float] | None = None,
    dt: float | None = None,
    grid: bool = True,
    stamps: str | None = None,
    model_arguments: Mapping | None = None,
    seed: int = 0,
    **numbers,
) -> LogEstimate:
    """Run a filter over a log, and a smoother after it if that is asked for.

    The numbers are those of `EstimateState(gym.make("Replay-v0", log=log, model=model), ...)` after
    `reset(seed=seed)`. A log on its own stamps is filtered by the clock, as by `filter.live()`: the Q of a step
    follows from its length, by the rates of a `ContinuousModel`, else in proportion.

    Args:
        log: recorded run, or the path of a file.
        filter: as `EstimateState` takes it; "ekf" if None and no tuned file.
        model: of the log, as `thruster_env.env.model_env.ReplayEnv` takes it: a model, a function that makes one,
            an object that offers one, or "module:object".
        tuned: path of a tuned file, which gives filter, parameters and model arguments.
        smoother: whether estimates are corrected by later measurements.
        lag: how many later measurements, also without `smoother`; all if None.
        columns: headers by quantity, as `thruster_env.logs.read.read_log` takes them.
        clock_offset: clock offsets [s] by quantity, as `read_log` takes them.
        dt: sample time [s], as `read_log` takes it. Covariances are per step and do not scale with dt.
        grid: whether a file is put on a grid, as `read_log` takes it.
        stamps: "header" or "receipt" of a bag, as `read_log` takes it.
        model_arguments: arguments of the function that makes the model, such as `process_noise_cov`.
        seed: of the filter's random numbers.
        **numbers: the filter's own parameters, such as `ensemble_size`.

    Raises:
        ValueError: if an argument is wrong, or the file, the model and the filter do not fit.
    """
    of_times: dict[str, Any] = {"clock_offset": clock_offset, "dt": dt, "stamps": stamps}
    env = ReplayEnv(log, model, columns=columns, grid=grid, **of_times)
    filter_ = filter_for(env, filter, None, None if tuned is None else str(tuned), model_arguments, numbers)
    noise = None if env.log.stamps is None else noise_by_rates(env.continuous, filter_.model, env.log.dt)
    return estimate_with(filter_, env.log, smoother=smoother, lag=lag, seed=seed, noise=noise)


def lost_in_gaps(model: StateSpaceModel, log: Log) -> list[int]:
    """The rows after gaps in which a sensor has turned by more than 0.3 rad, at the log's mean square rate.

    Of models with a gyroscope as input, whose attitude a magnetometer determines, so that it can begin anew.
    """
    rates = [i for i, quantity in enumerate(log.input_quantities) if quantity.symbol.startswith("gyr_")]
    if not (model.turns and rates and any(quantity.symbol.startswith("mag_") for quantity in log.measured)):
        return []
    apart = np.diff(log.times)
    pauses = np.flatnonzero(apart > (MOST_HELD + 1.5) * np.median(apart))  # of a log on its own stamps
    gaps = [(row, row + 1) for row in pauses.tolist()] if log.stamps is not None else []
    gaps += [(first - 1, first + count) for first, count in log.recording.gaps]
    rate, rows = float(np.sqrt(np.mean(np.sum(log.inputs[:, rates] ** 2, axis=1)))), list[int]()
    for before, after in gaps:
        far = rate * (log.times[after] - log.times[before]) > LOST
        if far and min(after - max([0, *rows]), log.steps + 1 - after) > FEWEST_STEPS:
            rows.append(after)
    return rows


def estimate_with(
    filter_: Filter,
    log: Log,
    *,
    smoother: bool = False,
    lag: int | None = None,
    seed: int = 0,
    noise: Callable[[float], np.ndarray] | None = None,
) -> LogEstimate:
    """Run a given filter over a log; of a model with rotations it begins at the first measurement.

    It begins anew in the rows of `lost_in_gaps`.

    Args:
        filter_: the filter.
        log: the log.
        smoother: as `estimate` takes it.
        lag: likewise.
        seed: likewise.
        noise: of a log on its own stamps, Q by the length of a step [s]; None for one in proportion to it.
    """
    smoother = smoother or lag is not None
    starts = [0, *lost_in_gaps(filter_.model, log)]
    if len(starts) > 1:
        counts = np.diff([*starts, log.steps + 1]).tolist()
        parts = [piece_of(log, first, count) for first, count in zip(starts, counts, strict=True)]
        return _joined(
            log,
            [estimate_with(filter_, part, smoother=smoother, lag=lag, seed=seed, noise=noise) for part in parts],
        )
    measurements = seen_by(filter_.model, log.measurements)
    data = filter_keys([at_least("seed", seed, 0)]), log.inputs[None], measurements[None]
    if filter_.model.turns:
        first = begun_at(filter_.model, first_measured(data[2]))[0]
        filter_ = replace(filter_, model=filter_.model.replace(prior_mean=first))
    if log.stamps is not None:
        estimates, restarts = by_the_clock(filter_, data[0][0], log, noise)
    elif isinstance(filter_, ForeignFilter):
        estimates, restarts = run(filter_, *data), None
    else:
        estimates, restarts = _stepped(filter_, *data)
    means, covs = estimates.means, estimates.covs
    if smoother:
        dt = None if log.stamps is None else np.diff(log.times)
        means, covs = smoothed_rows(prepared(filter_, *data, dt=dt, noise=noise), lag)[0]
    likelihoods, turns = estimates.log_likelihoods[0], filter_.model.measured_turns
    return LogEstimate(
        log,
        filter_,
        means[0],
        stored_covs(means, covs, filter_.model.turns)[0],
        np.where(np.isnan(readings(measurements, turns)), np.nan, estimates.innovations[0]),
        estimates.innovation_covs[0],
        likelihoods if filter_.has_covariance else np.full_like(likelihoods, np.nan),
        int(estimates.divergences[0]),
        smoother,
        noise,
        restarts,
    )


def _joined(log: Log, parts: Sequence[LogEstimate]) -> LogEstimate:
    """The estimates of a log from those of its parts, whose gaps have been predicted over."""
    rows: dict[str, Any] = {}
    for name in LogEstimate._fields[2:7]:  # means to log_likelihoods
        rows[name] = np.concatenate([getattr(part, name) for part in parts])
    restarts = next((part.restarts for part in parts if part.restarts is not None), None)
    return parts[0]._replace(
        log=log, divergences=sum(part.divergences for part in parts), restarts=restarts, **rows
    )


def _stepped(
    filter_: Filter, keys: np.ndarray, inputs: np.ndarray, measurements: np.ndarray
) -> tuple[Estimates, Restarts | None]:
    """Estimates of one trajectory by a wrapper's steps, equal to `run` to the last bit, and the restarts."""
    session, z, first = Session(filter_), measurements[0], FirstRestart(filter_)
    session.start(keys[0], z[0])
    rows = []
    for k in range(len(z)):
        if k:
            session.step(inputs[0, k - 1].tolist(), z[k])
        rows.append(session.latest())
        first.note(session, inputs[0, k - 1] if k else None, z[k])
    return estimates_of(rows, session.divergences), first.restarts(session.divergences)
