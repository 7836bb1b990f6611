"""The log-likelihood of logs as a function of a model's free parameters, with its derivatives and its maximum.

In order: the effect of a gate for outliers on variances and standard errors; the objective.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import combinations
from typing import Any

import numpy as np

from filters.registry import make_filter
from filters.sensitivity import sensitivity
from filters.starts import Starts
from thruster_env.core.checks import one_of, short_repr
from thruster_env.logs.log import Log
from thruster_env.model.state_space import StateSpaceModel
from tuning.identification.starts import runs_of
from tuning.likelihood.ascent import Ascent, Evaluation, climb  # noqa: F401 - `tuning.series` takes them from here
from tuning.likelihood.parametric import STEP, ParametricModel  # noqa: F401
from tuning.problems.data import Data
from tuning.problems.problem import Coordinates

FILTERS = "kf", "ekf"
LARGE_STEP = 1e-2  # of differences of the likelihood itself
COVARIANCES = "process_noise_cov", "measurement_noise_cov", "prior_cov"
BLOCKS = 20  # least number of blocks of all runs, whose scores give the scatter


def kept_variance(gate: float) -> float:
    """Variance of a standard normal number that is kept where its magnitude is at most c.

        E[x^2 | |x| <= c] = 1 - 2 c phi(c)/(2 Phi(c) - 1)

    Args:
        gate: c, positive; infinite for no gate, where it is 1.

    Source: Johnson, Kotz, Balakrishnan (1994), Continuous Univariate Distributions, volume 1, section 13.10.1.
    """
    return 1.0 - _edge(gate)


def lost_information(gate: float) -> float:
    """How much larger the variance of an estimated log-variance is: 2/var(x^2 | |x| <= c), 1 without a gate.

    That of a constant, 1/kappa^2 with kappa the `kept_variance`, is smaller.
    """
    variance = kept_variance(gate)
    fourth = 3.0 * variance - (_edge(gate) * gate**2 if gate < math.inf else 0.0)
    return 2.0 / (fourth - variance**2)


def _edge(gate: float) -> float:
    """2 c phi(c)/(2 Phi(c) - 1)."""
    if gate > 38.0:  # phi is no number of floating point any more
        return 0.0
    return 2.0 * gate * math.exp(-0.5 * gate**2) / math.sqrt(2.0 * math.pi) / math.erf(gate / math.sqrt(2.0))


class Objective:
    """Log-likelihood of a filter's innovations over logs, as a function of coordinates (p,) of free parameters.

    Args:
        data: `Data`, a `Log`, a sequence of these, or a function of some free parameters (its arguments) that
            returns these: a clock offset moves the data. Its attribute `noise_factors`, a function of the same
            parameters, may return factors on R by channel, where it interpolates.
        model: `model(**values)`, the model for values of the parameters that `data` does not take.
        coordinates: coordinates of the parameters.
        filter: "ekf" or "kf".
        degrees: of freedom of Student-t innovations; infinite for normal ones.
        predicted: symbols of channels that the filter predicts, but does not use.
        simulation: whether Q is set to zero: the filter then simulates, and -log L is a sum of squares.
        starts: of runs that do not begin as the model's prior says; None if all do.
        gate: number of standard deviations beyond which samples were left out; infinite if none were. The squares
            of what is left are then smaller than S by `kept_variance`, and are divided by that.

    Raises:
        ValueError: where models or data do not fit.
    """

    def __init__(
        self,
        data: Data | Log | Sequence[Data | Log] | Callable,
        model: Callable[..., StateSpaceModel],
        coordinates: Coordinates,
        *,
        filter: str = "ekf",
        degrees: float = math.inf,
        predicted: Sequence[str] = (),
        simulation: bool = False,
        starts: Starts | None = None,
        gate: float = math.inf,
    ):
        """Find the parameters that have sensitivities; see the class for the arguments."""
        self.filter = one_of("filter", filter, FILTERS)
        self.coordinates, self._model, self.degrees, self.simulation = coordinates, model, degrees, simulation
        self._of_data = _arguments_among(data, coordinates.names) if callable(data) else ()
        self.first_model = self._given_model(**coordinates.named(coordinates.start()))
        self.data: Data | Callable[..., Any] = data if callable(data) else runs_of(data, self.first_model)
        self.evaluations, self.starts, self.gate = 0, starts, gate
        self.predicted = tuple(predicted)
        at = coordinates.start()
        self._models = ParametricModel(self._given_model, coordinates, self._as_filtered)
        moving = [j for j, name in enumerate(coordinates.names) if name in self._of_data]
        self.rough = tuple(sorted({*moving, *self._models.rough}))  # parameters without sensitivities, by index
        self._smooth = [j for j in range(len(at)) if j not in self.rough]
        runs = self.data_at(at)
        _check_runs(runs, self.model_at(at))
        self.unseen = _checked_channels(self.predicted, self.model_at(at))
        count = len(runs.measurements)
        self.blocks = 1 if count >= BLOCKS else -(-BLOCKS // count)

    def with_changes(self, **changes) -> Objective:
        """The same with other data, filter, degrees, simulation, starts or gate."""
        data = changes.pop("data", self.data)
        return Objective(data, self._model, self.coordinates, **{**self._settings, **changes})

    def __reduce__(self) -> tuple[Callable[..., Objective], tuple]:
        """Copy it by its arguments: what follows from them is computed anew where they arrive."""
        return partial(Objective, **self._settings), (self.data, self._model, self.coordinates)

    @property
    def _settings(self) -> dict[str, Any]:
        names = "filter", "degrees", "predicted", "simulation", "starts", "gate"
        return {name: getattr(self, name) for name in names}

    def model_at(self, at: np.ndarray) -> StateSpaceModel:
        """The model at coordinates, as the filter runs on it."""
        return self._models.at(at)

    def _as_filtered(self, model: StateSpaceModel, at: np.ndarray) -> StateSpaceModel:
        """A model as the filter runs on it."""
        model = make_filter(self.filter, model).kernel_model
        if self._noise_factors_of is not None:
            roots = np.sqrt(self._noise_factors(at, model))
            model = model.replace(measurement_noise_cov=model.measurement_noise_cov * np.outer(roots, roots))
        if self.simulation:
            model = model.replace(process_noise_cov=np.zeros((model.t, model.t)))
        return model

    def _given_model(self, **values: float) -> StateSpaceModel:
        return self._model(**{name: value for name, value in values.items() if name not in self._of_data})

    def data_at(self, at: np.ndarray) -> Data:
        """The runs at coordinates."""
        if not callable(self.data):
            return self.data
        named = self.coordinates.named(at)
        return runs_of(self.data(**{name: named[name] for name in self._of_data}), self.first_model)

    @property
    def _noise_factors_of(self) -> Callable[..., Mapping[str, float]] | None:
        """Of data that are interpolated: a function of their parameters that returns factors on R by channel."""
        return getattr(self.data, "noise_factors", None)

    def _noise_factors(self, at: np.ndarray, model: StateSpaceModel) -> np.ndarray:
        """Factors on R of each channel (m,)."""
        of_data, named = self._noise_factors_of, self.coordinates.named(at)
        factors = {} if of_data is None else of_data(**{name: named[name] for name in self._of_data})
        return np.array([factors.get(channel.symbol, 1.0) for channel in model.measurements])

    def value(self, at: np.ndarray) -> float:
        """Log-likelihood of all runs; minus infinity where it is not finite."""
        return self._smooth_part(at, ()).value

    def __call__(self, at: np.ndarray) -> Evaluation:
        """Log-likelihood and its derivatives at coordinates."""
        here = self._smooth_part(at, self._smooth)
        if not self.rough:
            return here
        p, smooth = len(at), self._smooth
        gradient, information = np.zeros(p), np.zeros((p, p))
        scores = np.zeros((len(here.scores), p))
        gradient[smooth], scores[:, smooth] = here.gradient, here.scores
        information[np.ix_(smooth, smooth)] = here.information
        steps = LARGE_STEP * np.eye(p)
        sides = {j: [self._smooth_part(at + sign * steps[j], smooth) for sign in (1.0, -1.0)] for j in self.rough}
        for j, (above, below) in sides.items():
            gradient[j] = (above.value - below.value) / (2 * LARGE_STEP)
            scores[:, j] = (above.part_values - below.part_values) / (2 * LARGE_STEP)
            row = (below.gradient - above.gradient) / (2 * LARGE_STEP)
            information[j, smooth] = information[smooth, j] = row
            curvature = (2 * here.value - above.value - below.value) / LARGE_STEP**2
            information[j, j] = max(curvature, 1e-3 * abs(curvature), 1e-6)
        for j, i in combinations(self.rough, 2):  # both move together: f(+, +) + f(-, -) has their mixed slope
            both = sum(self.value(at + sign * (steps[j] + steps[i])) for sign in (1.0, -1.0))
            apart = sum(side.value for k in (j, i) for side in sides[k])
            information[j, i] = information[i, j] = (apart - both - 2 * here.value) / (2 * LARGE_STEP**2)
        return here._replace(gradient=gradient, information=information, scores=scores)

    def _smooth_part(self, at: np.ndarray, indices: Sequence[int]) -> Evaluation:
        self.evaluations += 1
        model, slopes = self.model_at(at), self._models.slopes(at, indices)
        runs, starts, variance = self.data_at(at), self.starts, kept_variance(self.gate)
        if variance < 1.0:  # a common factor on Q, R and P moves no estimate
            model = model.replace(**{name: variance * getattr(model, name) for name in COVARIANCES})
            slopes = slopes._replace(**{name: variance * getattr(slopes, name) for name in COVARIANCES})
            starts = None if starts is None else starts._replace(covs=variance * starts.covs)
        result = sensitivity(
            model,
            runs.inputs,
            runs.measurements,
            slopes,
            degrees=self.degrees,
            blocks=self.blocks,
            predicted=self.unseen,
            starts=starts,
        )
        scores, counts = np.concatenate(result.block_gradients), self._counted(runs)

        def of_samples(values, counts):  # densities of all samples, not of those within the gate or of averages
            if variance < 1.0:
                values = values + 0.5 * math.log(variance) * counts.sum(axis=-1)
            if self._noise_factors_of is not None:
                values = values + 0.5 * counts @ np.log(self._noise_factors(at, model))
            return values

        value = float(of_samples(result.values, counts.sum(axis=1)).sum())
        value = value if math.isfinite(value) else -math.inf
        part_values = of_samples(result.block_values, counts).ravel()
        return Evaluation(value, scores.sum(axis=0), result.information.sum(axis=0), scores, part_values)

    def moves_prior(self, at: np.ndarray) -> bool:
        """Whether some free parameter moves the prior of the first state, which is then what it says.

        A run of a model with rotations always begins where its first measurement says.
        """
        if self.first_model.turns:
            return False
        slopes = self._models.slopes(at, self._smooth)
        rough = [self._models.pair(at, j) for j in self.rough]
        apart = [
            np.abs(a.prior_mean - b.prior_mean).sum() + np.abs(a.prior_cov - b.prior_cov).sum() for a, b in rough
        ]
        return bool(slopes.prior_mean.any() or slopes.prior_cov.any() or np.any(apart))

    def _counted(self, runs: Data) -> np.ndarray:
        """Number of samples of each run, block and channel that count, (B, blocks, m)."""
        count, rows, channels = runs.measurements.shape
        counted = ~np.isnan(runs.measurements)
        if self.starts is not None:
            counted &= (np.arange(rows) >= self.starts.counted_from[:, None])[..., None]
        counts = np.zeros((count, self.blocks, channels), dtype=np.int64)
        for block, rows_of in enumerate(np.arange(rows) * self.blocks // rows == np.arange(self.blocks)[:, None]):
            counts[:, block] = counted[:, rows_of].sum(axis=1)
        return counts


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
    if sizes != (model.inputs, model.m):
        raise ValueError(
            f"data must have the model's {model.inputs} inputs and {model.m} measurements, "
            f"but got {short_repr(sizes)}"
        )
    empty = np.isnan(run.measurements).all(axis=(0, 1))
    if empty.any():
        missing = ", ".join(
            channel.symbol for channel, none in zip(model.measurements, empty, strict=True) if none
        )
        raise ValueError(f"data must have measurements of each channel, but have none of {missing}")


def _checked_channels(predicted: Sequence[str], model: StateSpaceModel) -> list[bool]:
    """Which channels are only predicted; ValueError for an unknown one, or if all are."""
    symbols = [channel.symbol for channel in model.measurements]
    for symbol in predicted:
        one_of("a predicted channel", symbol, symbols)
    unseen = [symbol in predicted for symbol in symbols]
    if all(unseen):
        raise ValueError(f"a filter must see some channel, but {', '.join(symbols)} are only predicted")
    return unseen
