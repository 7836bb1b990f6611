"""A filter's model as a function of tuned parameters, and scores of runs with their derivatives along these."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from filters.differentiated.recursion import LIKELIHOOD, Wanted
from filters.differentiated.runs import KINDS, ModelSlopes, Truth, derivatives, has_derivatives
from filters.estimators.foreign import is_foreign
from filters.filter import PageFilter
from filters.registry import filter_type, make_filter
from thruster_env.core.checks import one_of
from thruster_env.model.state_space import StateSpaceModel
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
    model_parameters,
    obeying,
)
from tuning.search.space import Choice

LEAST_NUMBERS = 8  # number of parameters from which the information is faster than differences

# Q or R as a function of tuned parameters, with exact derivatives.


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


def keeps_more(name: str) -> bool:
    """Whether a filter with a page keeps more than mean and covariance, such as an estimate of R."""
    kind = filter_type(name).filter_class
    return issubclass(kind, PageFilter) and kind.page.initial is not None


def check_gradient(name: str, what: str = "filter") -> None:
    """Raise ValueError for a filter without exact gradients."""
    if not has_gradient(name):
        one_of(what, name, DIFFERENTIABLE)


class Family:
    """The models that a problem's filter assumes, by the coordinates (p,) of parameters.

    Args:
        choice: of one of the `DIFFERENTIABLE` filters; its other parameters are held.
        problem: makes the models.
        parameters: the p parameters.

    Raises:
        ValueError: if a parameter is a whole number, or changes functions of the model and not its numbers alone.
    """

    def __init__(self, choice: Choice, problem: Problem, parameters: Sequence[Parameter]):
        """Find out whether all parameters are of Q and R, of which derivatives are known."""
        self.coordinates, self._choice, self._problem = Coordinates(parameters), choice, problem
        if any(parameter.tied or parameter.held for parameter in parameters):
            self._choice = choice = obeying(choice, parameters)
        self._filter = make_filter(choice.name, self._model(choice), **choice.numbers)
        self._base, self._noise = self._filter.model, None
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

    @property
    def states(self) -> int:
        """Number of states of the models."""
        return self._base.n

    def at(self, point: np.ndarray) -> tuple[StateSpaceModel, ModelSlopes]:
        """The model at coordinates, and its derivatives by them: exact of Q and R, else central differences."""
        if self._noise is not None:
            values, units = self.coordinates.values(point), self.coordinates.units
            (q, by_q), (r, by_r) = (noise.at(values, units) for noise in self._noise)
            model = self._base.replace(process_noise_cov=q, measurement_noise_cov=r)
            return model, ModelSlopes.of(model, len(point), process_noise_cov=by_q, measurement_noise_cov=by_r)
        return self._models.at(point), self._models.slopes(point, range(len(point)))

    def derivatives(
        self,
        point: np.ndarray,
        data: Data,
        *,
        score: str = LIKELIHOOD,
        information: bool = False,
        truth: Truth | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Scores of B runs with their gradients, (B, 1 + p), and Fisher's information, (B, p, p), if wanted.

        The lead-in of runs, in which the filter settles, is left out; so is what a run was padded with.
        """
        return self._along(*self.at(point), data, score, information, truth)

    def by_noise(
        self, choice: Choice, data: Data, *, score: str = LIKELIHOOD, truth: Truth | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Scores of B runs, (B,), and the derivatives of their sum by the matrices Q, (n, n), and R, (m, m).

        d score = tr(G_Q dQ) + tr(G_R dR),   G symmetric
        """
        model = self._model(choice)
        q, r = symmetric_units(model.n), symmetric_units(model.m)
        still = np.zeros((len(r), model.n, model.n)), np.zeros((len(q), model.m, model.m))
        moves = {"process_noise_cov": np.concatenate([q, still[0]])}
        moves["measurement_noise_cov"] = np.concatenate([still[1], r])
        scores, _ = self._along(model, ModelSlopes.of(model, len(q) + len(r), **moves), data, score, False, truth)
        total = scores[:, 1:].sum(axis=0)
        halves = [
            np.tensordot(gradient, unit, 1) for gradient, unit in ((total[: len(q)], q), (total[len(q) :], r))
        ]
        by_q, by_r = (0.5 * (half + np.diag(np.diag(half))) for half in halves)
        return scores[:, 0], by_q, by_r

    def _along(
        self, model: StateSpaceModel, slopes: ModelSlopes, data: Data, score: str, information: bool, truth
    ) -> tuple[np.ndarray, np.ndarray]:
        """What `derivatives` returns, of a model with its slopes."""
        wanted = Wanted(information, constants=bool(slopes.constants.any()), tails=False, score=score)

        def of(runs: Data) -> tuple[np.ndarray, np.ndarray]:
            arguments = model, runs.seen.inputs, runs.seen.measurements, slopes, wanted
            out, information_of_runs = derivatives(*arguments, truth=truth, used=self._filter)
            return out[:, 0], information_of_runs

        result = of(data)
        if truth is not None or not (self._problem.leads_in and data.first_scored):
            return result
        before = of(data.beginning)
        return result[0] - before[0], result[1] - before[1]

    def choice_at(self, point: np.ndarray) -> Choice:
        """The choice at coordinates."""
        return self._with(self.coordinates.values(point).tolist())

    def _made(self, **values: float) -> StateSpaceModel:
        return self._model(self._with(values.values()))

    def _with(self, values: Iterable[float]) -> Choice:
        choice = self._choice
        for parameter, value in zip(self.coordinates.free, values, strict=True):
            choice = parameter.set(choice, value)
        return choice

    def _model(self, choice: Choice) -> StateSpaceModel:
        model = self._problem.started_for(choice.name, self._problem.model(**choice.model))
        return make_filter(choice.name, model).kernel_model


def symmetric_units(size: int) -> np.ndarray:
    """The symmetric matrices with one entry, or two mirrored ones, of 1: (n (n + 1) / 2, n, n)."""
    pairs = [(i, j) for i in range(size) for j in range(i + 1)]
    units = np.zeros((len(pairs), size, size))
    for unit, (i, j) in zip(units, pairs, strict=True):
        unit[i, j] = unit[j, i] = 1.0
    return units


def known_information(
    choice: Choice,
    scenarios: Sequence[Problem],
    data: Sequence[Data],
    names: Sequence[str],
    values: np.ndarray,
    where: Sequence[str] = (),
) -> np.ndarray | None:
    """Fisher information on the logarithms of a Kalman filter's parameters in each of B runs, (B, p, p).

    None for other filters, and where a parameter changes the model's functions or is on another scale. It takes
    the time of about fifteen runs of the filter; differences take two runs for each pair of parameters.

    Args:
        choice: choice of one filter type; its other parameters are held.
        scenarios: the problems.
        data: for each scenario, its runs.
        names: names of the p parameters.
        values: at which the information is taken, (p,).
        where: relations among the model's numbers.
    """
    if not has_gradient(choice.name) or len(names) < LEAST_NUMBERS:
        return None
    matrices = []
    for scenario, runs in zip(scenarios, data, strict=True):
        free = model_parameters(scenario, where=where)
        known = {parameter.name: parameter for parameter in free if parameter.log}
        if not set(names) <= set(known):
            return None
        try:
            family = Family(choice, scenario, [known[name] for name in names])
            matrices.append(family.derivatives(np.log(values), runs, information=True)[1])
        except ValueError:  # more than numbers changes
            return None
    return np.concatenate(matrices)
