"""Recorded runs, and a filter's model of them as a function of free parameters: what `identify` searches."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from filters.registry import make_filter
from filters.sensitivity import ModelSlopes
from thruster_env.core.checks import one_of, short_repr
from thruster_env.logs.log import Log
from thruster_env.model.state_space import StateSpaceModel
from tuning.identification.starts import runs_of
from tuning.likelihood.objective import Innovations, Objective, Part
from tuning.likelihood.parametric import ParametricModel
from tuning.problems.data import Data
from tuning.problems.problem import Coordinates

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
        return np.array([factors.get(channel.symbol, 1.0) for channel in self.first_model.measurements])


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
