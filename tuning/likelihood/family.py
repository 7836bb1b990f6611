"""Runs of a problem, and the model that a filter assumes of them as a function of tuned parameters."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from filters.estimators.foreign import is_foreign
from filters.filter import Filter
from filters.registry import filter_type, make_filter
from filters.sensitivity import KINDS, ModelSlopes, has_derivatives
from thruster_env.core.checks import one_of
from thruster_env.model.state_space import StateSpaceModel
from tuning.likelihood.objective import Part
from tuning.likelihood.parametric import ParametricModel
from tuning.problems.data import Data
from tuning.problems.problem import Coordinates, Parameter, Problem
from tuning.search.parameters import (
    CORRELATIONS,
    Correlation,
    MeasurementVariance,
    ProcessVariance,
    Q,
    R,
    correlation_slopes,
    correlations_of,
    full_covariance,
    obeying,
)
from tuning.search.space import Choice, neutral


class TunedCovariance:
    """A covariance (n, n), of which some variances and correlations are tuned.

    Where no correlation is tuned, a variance scales its row and column: C = D C_0 D, with D the roots of what the
    variances have grown by. Else C is the `full_covariance` of both.

    Args:
        base: the covariance before.
        name: of the covariance, as places of correlations have it.
        variance: the kind of places that its variances are.
        settings: for each of p parameters the places that it sets, and by which factors.
    """

    def __init__(
        self,
        base: np.ndarray,
        name: str,
        variance: type[ProcessVariance | MeasurementVariance],
        settings: Sequence[Sequence[tuple[Any, float]]],
    ):
        """Find the parameters of this covariance."""
        self._base, self._count = base, len(settings)
        all_places: list[tuple[int, Any, float]] = [
            (i, position, factor) for i, positions in enumerate(settings) for position, factor in positions
        ]
        self._variances = [
            (i, position.index, by) for i, position, by in all_places if isinstance(position, variance)
        ]
        self._correlations = [
            (i, position.index, by)
            for i, position, by in all_places
            if isinstance(position, Correlation) and position.covariance == name
        ]

    def at(self, values: np.ndarray, units: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The covariance and its derivatives (p, n, n) by coordinates, for values and units of all parameters."""
        n = len(self._base)
        variances = np.diag(self._base).copy()
        for i, at, factor in self._variances:
            variances[at] = factor * values[i]
        slopes = np.zeros((self._count, n, n))
        if self._correlations:
            correlations = np.clip(correlations_of(self._base), *CORRELATIONS)
            for i, k, factor in self._correlations:
                correlations[k] = factor * values[i]
            cov = full_covariance(variances.tolist(), correlations.tolist())
            by_correlations = correlation_slopes(variances.tolist(), correlations.tolist())
            for i, k, factor in self._correlations:
                slopes[i] += factor * units[i] * by_correlations[k]
        else:
            grown = np.sqrt(variances / np.where(np.diag(self._base) > 0, np.diag(self._base), 1.0))
            cov = self._base * np.outer(grown, grown)
            cov[range(n), range(n)] = variances
        for i, at, _ in self._variances:  # of logarithms, to which factors do nothing
            slopes[i, at] += 0.5 * cov[at]
            slopes[i, :, at] += 0.5 * cov[at]
        return cov, slopes


DIFFERENTIABLE = tuple(kind.name for kind in KINDS)  # filters, and those of users that `has_gradient` knows


def has_gradient(name: str) -> bool:
    """Whether a filter, or a user's by "module:class", has exact gradients."""
    return name in DIFFERENTIABLE or (is_foreign(name) and has_derivatives(filter_type(name).filter_class))


def check_gradient(name: str, what: str = "filter") -> None:
    """Raise ValueError for a filter without exact gradients."""
    if not has_gradient(name):
        one_of(what, name, DIFFERENTIABLE)


class Family(Part):
    """Runs of a problem, and the models that its filter assumes, by the coordinates (p,) of parameters.

    Args:
        choice: of one of the `DIFFERENTIABLE` filters; its other parameters are held.
        problem: makes the models.
        parameters: the p parameters.
        data: the runs.

    Raises:
        ValueError: if a parameter is a whole number, or changes functions of the model and not its numbers alone.
    """

    def __init__(self, choice: Choice, problem: Problem, parameters: Sequence[Parameter], data: Data):
        """Find out whether all parameters are of Q and R, of which derivatives are known."""
        self.data, self.leads_in, self.scale = data, problem.leads_in, problem.scale
        self.coordinates, self._choice, self._problem = Coordinates(parameters), choice, problem
        values = [(parameter.get(choice), neutral(parameter.name)) for parameter in parameters]
        self.untuned = np.array([other if value is None else value for value, other in values], dtype=np.float64)
        if any(parameter.tied or parameter.held for parameter in parameters):
            self._choice = choice = obeying(choice, parameters)
        self.used = make_filter(choice.name, self.model_of(choice), **choice.numbers)
        self._base, self._noise, self.states = self.used.model, None, self.used.model.n
        settings = [((parameter.place, 1.0), *parameter.tied) for parameter in parameters]  # by each parameter
        kinds = ProcessVariance, MeasurementVariance, Correlation
        if all(isinstance(position, kinds) for positions in settings for position, _ in positions):
            q = TunedCovariance(self._base.process_noise_cov, Q, ProcessVariance, settings)
            self._noise = q, TunedCovariance(self._base.measurement_noise_cov, R, MeasurementVariance, settings)
            return
        self._models = ParametricModel(self._made, self.coordinates, lifts=False)
        if self._models.rough:
            name = self.coordinates.names[self._models.rough[0]]
            raise ValueError(
                "parameters of a gradient must change numbers of the model alone, "
                f"but {name} changes its functions"
            )

    def at(self, point: np.ndarray, indices: Sequence[int] | None = None) -> tuple[StateSpaceModel, ModelSlopes]:
        """The model at coordinates, and its derivatives by them: exact of Q and R, else central differences."""
        chosen = list(range(len(point)) if indices is None else indices)
        if self._noise is not None:
            values, units = self.coordinates.values(point), self.coordinates.units
            (q, by_q), (r, by_r) = (noise.at(values, units) for noise in self._noise)
            model = self._base.replace(process_noise_cov=q, measurement_noise_cov=r)
            moves = {"process_noise_cov": by_q[chosen], "measurement_noise_cov": by_r[chosen]}
            return model, ModelSlopes.of(model, len(chosen), **moves)
        return self._models.at(point), self._models.slopes(point, chosen)

    def choice_at(self, point: np.ndarray) -> Choice:
        """The choice at coordinates."""
        return self._with(self.coordinates.values(point).tolist())

    def _made(self, **values: float) -> StateSpaceModel:
        return self.model_of(self._with(values.values()))

    def _with(self, values: Iterable[float]) -> Choice:
        choice = self._choice
        for parameter, value in zip(self.coordinates.free, values, strict=True):
            choice = parameter.set(choice, value)
        return choice

    def filter_at(self, point: np.ndarray) -> Filter:
        """The filter at coordinates."""
        return self.choice_at(point).filter(self._problem)

    def model_of(self, choice: Choice) -> StateSpaceModel:
        """The model of a choice, as the filter runs on it."""
        model = self._problem.started_for(choice.name, self._problem.model(**choice.model))
        return make_filter(choice.name, model).kernel_model
