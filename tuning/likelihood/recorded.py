"""Recorded runs, and a filter's model of them as a function of free parameters: what `identify` searches.

In order: the likelihood of recorded runs; clock offsets of channels, `clock_offset_CHANNEL`, positive if a clock
is ahead, which cover a constant delay, too (of a sensor whose reading arrives late, or of an actuator that acts
late, whose offset is negative); where a run begins, the model's prior or a state determined by its first rows.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from scipy.special import chdtri

from filters.engine.batch import Estimates, run
from filters.gaussian.extended import ExtendedKalmanFilter
from filters.registry import make_filter
from filters.sensitivity import ModelSlopes, sensitivity
from filters.starts import Starts, as_the_prior_says, begun_at, first_measured, wide_cov
from thruster_env.core.angles import difference
from thruster_env.core.checks import one_of, short_repr
from thruster_env.core.streams import filter_keys
from thruster_env.logs.grid import NEIGHBOURS
from thruster_env.logs.log import Log, at_offset, in_steps, seen_by
from thruster_env.model.state_space import StateSpaceModel
from thruster_env.model.turns import innovations_of, of_channels
from tuning.likelihood.objective import Innovations, Objective, Part
from tuning.likelihood.parametric import ParametricModel
from tuning.problems.data import Data, mask_of, padded
from tuning.problems.log_parts import LEAD, check_times
from tuning.problems.problem import Coordinates, Parameter

FILTERS = "kf", "ekf"


def likelihood_of(
    data: Data | Log | Sequence[Data | Log] | Callable,
    model: Callable[..., StateSpaceModel],
    coordinates: Coordinates,
    *,
    filter: str = "ekf",
    degrees: float = math.inf,
    predicted: Sequence[str] = (),
) -> Objective:
    """Log-likelihood of a filter's innovations over logs, as a function of coordinates (p,) of free parameters.

    Args:
        data: see `RecordedRuns`.
        model: see `RecordedRuns`.
        coordinates: of the parameters.
        filter: "ekf" or "kf".
        degrees: of freedom of Student-t innovations; infinite for normal ones.
        predicted: symbols of channels that the filter predicts, but does not use.

    Raises:
        ValueError: where models or data do not fit.
    """
    runs = RecordedRuns(data, model, coordinates, filter)
    return Objective([runs], innovations=Innovations(degrees, tuple(predicted)), information=True)


def recorded(objective: Objective) -> RecordedRuns:
    """The runs of an objective of `likelihood_of`."""
    (runs,) = objective.parts
    assert isinstance(runs, RecordedRuns)
    return runs


def of_changed(objective: Objective, *, simulation: bool = False, data: Any = None, **changes) -> Objective:
    """The same with other data, as a simulation, or with other fields of `Innovations`."""
    return objective.with_changes(parts=[recorded(objective).changed(data, simulation)], **changes)


class RecordedRuns(Part):
    """Runs of logs, and the models that a filter assumes of them, by the coordinates (p,) of free parameters.

    Args:
        data: `Data`, a `Log`, a sequence of these, or a function of some free parameters (its arguments) that
            returns these: a clock offset moves the data. Its attribute `noise_factors`, a function of the same
            parameters, may return factors on R by channel, where it interpolates.
        model: `model(**values)`, the model for values of the parameters that `data` does not take.
        coordinates: of the parameters.
        filter: "ekf" or "kf".
        simulation: whether Q is set to zero: the filter then simulates, and -log L is a sum of squares.

    Raises:
        ValueError: where models or data do not fit.
    """

    def __init__(
        self,
        data: Data | Log | Sequence[Data | Log] | Callable,
        model: Callable[..., StateSpaceModel],
        coordinates: Coordinates,
        filter: str = "ekf",
        *,
        simulation: bool = False,
    ):
        """Find the parameters that have sensitivities; see the class for the arguments."""
        self.filter = one_of("filter", filter, FILTERS)
        self.coordinates, self._model, self.simulation = coordinates, model, simulation
        self._of_data = _arguments_among(data, coordinates.names) if callable(data) else ()
        start = coordinates.start()
        self.first_model = self._made(**coordinates.named(start))
        self.data: Data | Callable[..., Any] = data if callable(data) else runs_of(data, self.first_model)
        self._models = ParametricModel(self._made, coordinates, self._as_filtered)
        moving = [j for j, name in enumerate(coordinates.names) if name in self._of_data]
        self.rough = tuple(sorted({*moving, *self._models.rough}))
        self.states, self.untuned = self.first_model.n, coordinates.values(start)
        _check_runs(self.data_at(start), self.model_at(start))

    def changed(self, data: Any, simulation: bool) -> RecordedRuns:
        """The same with other data, if there are any, or as a simulation."""
        data = self.data if data is None else data
        return RecordedRuns(data, self._model, self.coordinates, self.filter, simulation=simulation)

    def __reduce__(self) -> tuple[Callable[..., RecordedRuns], tuple]:
        """Copy it by its arguments: what follows from them is computed anew where they arrive."""
        make = partial(RecordedRuns, filter=self.filter, simulation=self.simulation)
        return make, (self.data, self._model, self.coordinates)

    def at(self, point: np.ndarray, indices: Sequence[int] | None = None) -> tuple[StateSpaceModel, ModelSlopes]:
        """The model at coordinates, as the filter runs on it, and its derivatives by some of them."""
        chosen = range(len(point)) if indices is None else indices
        return self._models.at(point), self._models.slopes(point, chosen)

    def _as_filtered(self, model: StateSpaceModel, at: np.ndarray) -> StateSpaceModel:
        """A model as the filter runs on it."""
        model = make_filter(self.filter, model).kernel_model
        factors = self.noise_factors(at)
        if factors is not None:
            roots = np.sqrt(factors)
            model = model.replace(measurement_noise_cov=model.measurement_noise_cov * np.outer(roots, roots))
        if self.simulation:
            model = model.replace(process_noise_cov=np.zeros((model.t, model.t)))
        return model

    def _made(self, **values: float) -> StateSpaceModel:
        return self._model(**{name: value for name, value in values.items() if name not in self._of_data})

    def _data_values(self, point: np.ndarray) -> Mapping[str, float]:
        named = self.coordinates.named(point)
        return {name: named[name] for name in self._of_data}

    def data_at(self, point: np.ndarray) -> Data:
        """The runs at coordinates."""
        if not callable(self.data):
            return self.data
        return runs_of(self.data(**self._data_values(point)), self.first_model)

    def noise_factors(self, point: np.ndarray) -> np.ndarray | None:
        """Factors on R of each channel (m,), where data are interpolated."""
        of_data = getattr(self.data, "noise_factors", None)
        if of_data is None:
            return None
        factors = of_data(**self._data_values(point))
        return np.array([factors.get(channel.symbol, 1.0) for channel in innovations_of(self.first_model)])


def _arguments_among(function: Callable, names: Sequence[str]) -> tuple[str, ...]:
    """The arguments of a function that are free parameters; its attribute `parameters` may list them."""
    if hasattr(function, "parameters"):
        return tuple(name for name in names if name in function.parameters)
    arguments = set(inspect.signature(function).parameters)
    if isinstance(function, partial):
        arguments -= set(function.keywords)
    return tuple(name for name in names if name in arguments)


def _check_runs(run: Data, model: StateSpaceModel) -> None:
    """Raise ValueError unless runs have the model's inputs and measurements, and samples in each channel."""
    sizes = run.inputs.shape[-1], run.measurements.shape[-1]
    if sizes != (model.inputs, model.channels):
        raise ValueError(
            f"data must have the model's {model.inputs} inputs and {model.channels} measurements, "
            f"but got {short_repr(sizes)}"
        )
    empty = np.isnan(run.measurements).all(axis=(0, 1))
    if empty.any():
        missing = ", ".join(
            channel.symbol for channel, none in zip(model.measurements, empty, strict=True) if none
        )
        raise ValueError(f"data must have measurements of each channel, but have none of {missing}")


CLOCK = "clock_offset_"  # at the beginning of a parameter's name
OFFSETS = 10.0  # largest clock offset, in sample times, but at least
LEAST_OFFSET = 0.1  # [s]


def clock_offsets(channels: Sequence[str], logs: Sequence[Log]) -> dict[str, Parameter]:
    """The parameter of each channel's clock offset by name, ten steps about that of the logs."""
    parameters, reach = {}, max(OFFSETS * logs[0].dt, LEAST_OFFSET)
    for channel in channels:
        name, at = f"{CLOCK}{channel}", _read_with(logs, channel)
        parameters[name] = Parameter(name, at - reach, at + reach, "s", log=False, default=at)
    return parameters


def shifted(logs: Sequence[Log], free: Sequence[Parameter]) -> tuple[Log, ...] | ShiftedLogs:
    """The logs, or a function of the clock offsets that are free."""
    names = tuple(parameter.name for parameter in free if parameter.name.startswith(CLOCK))
    return ShiftedLogs(logs, names) if names else tuple(logs)


def offsets_of(logs: Sequence[Log], channels: Sequence[str], values: Mapping[str, float]) -> dict[str, float]:
    """Clock offsets [s] by channel that are not zero: identified ones, or those of the logs."""
    offsets = {channel: values.get(CLOCK + channel, _read_with(logs, channel)) for channel in channels}
    return {channel: value for channel, value in offsets.items() if value}


def _read_with(logs: Sequence[Log], channel: str) -> float:
    """The clock offset with which all logs were read; 0 if they differ, since they then belong to the logs."""
    keys = f"measurement:{channel}", f"input:{channel}"
    offsets = {next((log.offsets[key] for key in keys if key in log.offsets), 0.0) for log in logs}
    return offsets.pop() if len(offsets) == 1 else 0.0


class ShiftedLogs:
    """Logs as a function of clock offsets of their channels [s].

    Of a shifted channel only every other row is used. It is interpolated between two samples, so that the noise of
    consecutive rows is correlated, and a likelihood of white noise would prefer a wrong offset. Every other row
    shares no sample with the next one.
    """

    def __init__(self, logs: Sequence[Log], names: Sequence[str]):
        """Take logs, and names such as clock_offset_CHANNEL."""
        self.logs, self.parameters = tuple(logs), tuple(names)

    def __call__(self, **offsets: float) -> list[Log]:
        """The logs with shifted clocks of the channels."""
        return [self._shifted(log, offsets) for log in self.logs]

    def noise_factors(self, **offsets: float) -> dict[str, float]:
        """Factors on the variance of white noise in each shifted channel, by symbol.

        An interpolated sample has weights w and 1 - w of its neighbours, and its noise w^2 + (1 - w)^2 of their
        variance. A likelihood without this factor would prefer offsets of half a sample.
        """
        factors = {}
        for name, seconds in offsets.items():
            symbol = name.removeprefix(CLOCK)
            if symbol not in [quantity.symbol for quantity in self.logs[0].measured]:
                continue  # an input is held, not interpolated
            parts = [_left(log, f"measurement:{symbol}", seconds) for log in self.logs]
            factors[symbol] = float(np.mean(np.concatenate(parts)))
        return factors

    def _shifted(self, log: Log, offsets: Mapping[str, float]) -> Log:
        symbols = [quantity.symbol for quantity in log.measured]
        for name, seconds in offsets.items():
            symbol = name.removeprefix(CLOCK)
            channel = f"{'measurement' if symbol in symbols else 'input'}:{symbol}"
            dense = symbol in symbols and np.median(np.diff(log.series(channel).times)) < NEIGHBOURS * log.dt
            log = at_offset(log, channel, seconds)
            if dense:
                rows = log.measurements.copy()
                rows[1::2, symbols.index(symbol)] = np.nan
                log = replace(log, measurements=rows)
        return log


def _left(log: Log, channel: str, seconds: float) -> np.ndarray:
    """w^2 + (1 - w)^2 of each row of a shifted channel that lies between two close samples."""
    samples = log.series(channel).times
    times = log.times + seconds
    after = np.clip(np.searchsorted(samples, times), 1, len(samples) - 1)
    gap = samples[after] - samples[after - 1]
    w = (times - samples[after - 1]) / gap
    between = (w >= 0) & (w <= 1) & (gap < NEIGHBOURS * log.dt)
    return w[between] ** 2 + (1 - w[between]) ** 2 if between.any() else np.ones(1)


PART = 4  # a lead-in is LEAD measured rows, at most the run's measured rows divided by this
LEVEL = 1e-3  # of the test by which a run does not begin as the prior says
STEPS = 20  # of Gauss and Newton, at most
ROUNDING = 1e-6  # of a variance
SETTLED = 0.1  # standard deviations by which a first state may still move


def starts_of(model: StateSpaceModel, runs: Data, unseen: Sequence[bool] | None = None) -> Starts:
    """The first state of each run, from its first rows alone, and which runs do not begin as the prior says.

    The first state m maximises the likelihood of the first rows for a filter that begins there without a variance,
    by Gauss-Newton steps (J + W^-1)^-1 g, with gradient g, Fisher information J and a wide covariance W. With the
    model's prior N(m_0, P_0) of n states,

        d = (m - m_0)' (P + P_0)^-1 (m - m_0),  P = (J + W^-1)^-1,

    is chi-squared with n degrees of freedom for a run that begins as the prior says. Where it is beyond the
    quantile of 1 - LEVEL the run begins elsewhere: its filter begins with N(m, W), and its lead-in does not count.
    What does is the likelihood of the later rows, given the first ones. A state that the first rows do not
    determine begins at the prior mean. Of a model with rotations each run begins where its first measurement says
    (`filters.starts.begun_at`).

    Args:
        model: of the filter.
        runs: inputs and measurements.
        unseen: (m,) which channels the filter only predicts.

    Source: Durbin, Koopman (2012), Time Series Analysis by State Space Methods, sections 5.2 and 5.7, on starts
    that are diffuse or unknown constants.
    """
    count = len(runs.measurements)
    starts = as_the_prior_says(model, count)
    measured = np.where(
        False if unseen is None else of_channels(unseen, model.measured_turns), np.nan, runs.measurements
    )
    starts.leads[:] = [_lead(run_measurements) for run_measurements in measured]
    if model.turns:
        first = first_measured(measured)
        return starts._replace(free=starts.leads > 0, means=begun_at(model, first))
    rows = max(int(starts.leads.max()), 1)
    measured, inputs = measured[:, :rows], runs.inputs[:, : rows - 1]
    measured = np.where((np.arange(rows) < starts.leads[:, None])[..., None], measured, np.nan)
    wide, guesses = _wide_and_guess(model, runs)
    best = [_first_states(model, wide, inputs, measured, guess) for guess in guesses]
    likeliest = np.argmax([estimate[2] for estimate in best], axis=0)
    for index, (choice, lead) in enumerate(zip(likeliest, starts.leads, strict=True)):
        mean, cov, value = (part[index] for part in best[choice])
        if lead > 0 and np.isfinite(value) and _is_elsewhere(model, mean, cov):
            starts.free[index], starts.means[index], starts.covs[index] = True, mean, wide
    return starts


def estimates_of(
    model: StateSpaceModel, runs: Data, starts: Starts | None, kind=ExtendedKalmanFilter
) -> Estimates:
    """What a filter makes of runs that begin where they do; innovations before the first row that counts are NaN.

    Args:
        model: of the filter.
        runs: inputs and measurements.
        starts: of the runs; None if all begin with the model's prior.
        kind: the filter, with no other argument than the model.
    """
    if starts is None or not starts.free.any():
        return run(kind(model=model), runs.filter_keys, runs.inputs, runs.measurements)
    single_runs = [runs.slice(index, index + 1) for index in range(len(runs.measurements))]
    parts = [
        run(kind(model=starts.model(model, index)), single.filter_keys, single.inputs, single.measurements)
        for index, single in enumerate(single_runs)
    ]
    return Estimates(*(np.concatenate([getattr(part, name) for part in parts]) for name in Estimates._fields))


def _wide_and_guess(model: StateSpaceModel, runs: Data) -> tuple[np.ndarray, list[np.ndarray]]:
    """The wide covariance (n, n) of `filters.starts.wide_cov`, and guesses (B, n).

    How far runs reach is what a simulation from the prior's mean says. Guesses are the prior's mean, and what the
    inputs lead to where the first one has acted for long.
    """
    nothing = np.zeros((model.n, model.n))
    simulated = ExtendedKalmanFilter(model=model.replace(process_noise_cov=nothing, prior_cov=nothing))
    first = np.repeat(runs.inputs[:, :1], LEAD, axis=1)
    blind = np.full((len(first), LEAD + 1, model.channels), np.nan)
    guesses = run(simulated, runs.filter_keys, first, blind).means[:, -1]
    silent = np.full_like(runs.measurements, np.nan)
    means = run(simulated, runs.filter_keys, runs.inputs, silent).means
    reach = np.abs(difference(means, model.prior_mean, model.shape.state_angles))
    reach = np.where(np.isfinite(reach), reach, 0.0).max(axis=(0, 1))
    at_prior = np.tile(model.prior_mean, (len(first), 1))
    settled = np.where(np.isfinite(guesses).all(axis=1, keepdims=True), guesses, at_prior)
    return wide_cov(model, reach), [at_prior, settled]


def _lead(measured: np.ndarray) -> int:
    """Rows of the lead-in of a run with measurements (K + 1, m); 0 for a run with too few."""
    rows = np.flatnonzero(~np.isnan(measured).all(axis=1))
    wanted = min(LEAD, len(rows) // PART)
    return int(rows[wanted - 1]) + 1 if wanted > 0 else 0


def _first_states(
    model: StateSpaceModel, wide: np.ndarray, inputs: np.ndarray, measured: np.ndarray, guess: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Likeliest first states (B, n), their covariances (B, n, n), and log-likelihoods (B,), from a guess."""
    n, count = model.n, len(measured)
    scale = np.sqrt(np.diag(wide))
    slopes = ModelSlopes.of(model, n, prior_mean=np.diag(scale))  # a unit is a wide standard deviation
    known = (scale > 0).astype(np.float64)

    def at(means: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        begun = Starts(np.ones(count, dtype=bool), means, np.zeros((count, n, n)), np.zeros(count, dtype=np.int64))
        result = sensitivity(model, inputs, measured, slopes, starts=begun._replace(held=False))
        parts = result.gradients, result.information
        fine = np.isfinite(result.values) & np.all(
            [np.isfinite(part).reshape(count, -1).all(axis=1) for part in parts], 0
        )
        return np.where(fine, result.values, -np.inf), *(
            np.nan_to_num(part, posinf=0.0, neginf=0.0) for part in parts
        )

    means, damping = np.array(guess), np.ones(count)
    values, gradients, information = at(means)
    for _ in range(STEPS):
        matrix = information + damping[:, None, None] * np.eye(n)
        step = known * np.linalg.solve(matrix, gradients[..., None])[..., 0]
        if (np.abs(step) <= SETTLED * np.sqrt(1.0 / np.einsum("bii->bi", matrix))).all():
            break
        further = means + scale * step
        after = at(further)
        better = after[0] > values
        damping = np.where(better, damping / 10.0, damping * 10.0)
        means = np.where(better[:, None], further, means)
        values, gradients, information = (
            np.where(better.reshape(-1, *[1] * (new.ndim - 1)), new, old)
            for new, old in zip(after, (values, gradients, information), strict=True)
        )
    covs = np.linalg.inv(information + np.eye(n))
    variances = np.einsum("bii->bi", covs)
    # Of a model that blows up along the first rows J is a number, and none of a Fisher information: then P > W.
    sound = np.isfinite(covs).all(axis=(1, 2)) & ((variances > 0.0) & (variances < 1.0 + ROUNDING)).all(axis=1)
    return means, covs * np.outer(scale, scale), np.where(sound, values, -np.inf)


def _is_elsewhere(model: StateSpaceModel, mean: np.ndarray, cov: np.ndarray) -> bool:
    """Whether a first state, known with a covariance, does not belong to the model's prior."""
    apart, total_cov = difference(mean, model.prior_mean, model.shape.state_angles), cov + model.prior_cov
    scale = np.sqrt(np.diag(total_cov))
    uncertain = scale > 0  # a state that is known exactly stays where it is
    if not uncertain.any():
        return False
    scaled = apart[uncertain] / scale[uncertain]
    values, axes = np.linalg.eigh(
        total_cov[np.ix_(uncertain, uncertain)] / np.outer(scale[uncertain], scale[uncertain])
    )
    along = scaled @ axes
    distance = (along**2 / np.maximum(values, 1e-10)).sum()
    return bool(distance > chdtri(int(uncertain.sum()), LEVEL))


def runs_of(data: Data | Log | Sequence[Data | Log], model: StateSpaceModel | None = None) -> Data:
    """Data and logs as one `Data`; keys and seeds are those of the runs' indices 0, 1, ...

    Logs on their own stamps have step ratios as their last input (`thruster_env.logs.log`). The first measurement
    of a log is left out if h of the model takes the input until then, which it does not have.

    Raises:
        ValueError: for anything else, for no run, for runs with different inputs, measurements or sample times.
    """
    parts = _listed(data)
    if not parts or not all(isinstance(part, Data | Log) for part in parts):
        raise ValueError(f"data must be some of Log or Data, but got {short_repr(data)}")
    if len(parts) == 1 and isinstance(parts[0], Data):
        return parts[0].seen
    check_times([part for part in parts if isinstance(part, Log)])
    inputs: list[np.ndarray] = []
    measurements: list[np.ndarray] = []
    for source in parts:
        if isinstance(source, Log):
            u, z = (source.inputs, source.measurements) if source.stamps is None else in_steps(source)
            z = z if model is None else seen_by(model, z)
            inputs, measurements = [*inputs, u], [*measurements, z]
            continue
        for part in map(source.one, range(len(source.seeds))):
            inputs += list(part.inputs)
            measurements += list(part.measurements)
    lengths = list(map(len, measurements))
    widths = {(u.shape[1], z.shape[1]) for u, z in zip(inputs, measurements, strict=True)}
    if len(widths) > 1:
        raise ValueError(f"runs must have the same inputs and measurements, but got {sorted(widths)} of each")
    rows, seeds = max(map(len, measurements)), tuple(range(len(inputs)))
    all_inputs, all_measurements = padded(inputs, rows - 1, None), padded(measurements, rows)
    return Data(seeds, all_inputs, all_measurements, filter_keys(seeds), 0, counted=mask_of(lengths, rows))


def _listed(data: Any) -> list[Data | Log]:
    """One or several runs as a list; empty for what is neither."""
    if isinstance(data, Data | Log):
        return [data]
    return list(data) if isinstance(data, Sequence) else []
