"""Q and R of a model as functions of the tuned parameters, with their derivatives."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from filters.likelihood import information
from filters.registry import make_filter
from plants.state_space import StateSpaceModel
from tuning.problems.data import Data
from tuning.problems.parameter import Parameter, Place
from tuning.problems.problem import Problem
from tuning.search.parameters import MeasurementVariance, ProcessVariance, model_parameters
from tuning.search.space import Choice

DIFFERENTIABLE = ("kf", "ekf")  # filters
LEAST_NUMBERS = 8  # number of parameters from which the information is faster than differences
STEP = 1e-4  # in the logarithms, of the differences of Q and R


def noise_family(choice: Choice, problem: Problem, parameters: Sequence[Parameter]) -> Callable:
    """The function noise_at(values, data) that returns the arguments of `filters.likelihood`.

    These are the model with the Q and R that follow from positive values (p,), the data's inputs and measurements,
    and the derivatives of Q and R by the logarithm of each value: exact for variances, else central differences.

    Args:
        choice: choice of a Kalman filter.
        problem: makes the model.
        parameters: the p parameters.

    Raises:
        ValueError: if a parameter is not on a logarithmic scale, or changes more of the model than Q and R.
    """
    model = make_filter(choice.name, problem.model(**choice.model)).kernel_model
    of_noise = all(isinstance(one.place, ProcessVariance | MeasurementVariance) for one in parameters)
    if of_noise and all(map(_is_diagonal, (model.process_noise_cov, model.measurement_noise_cov))):
        return _variances(model, parameters)
    for one in parameters:
        if not one.log:
            raise ValueError(f"parameters of a gradient must be on logarithmic scales, but {one.name} is not")

    def model_at(values: np.ndarray) -> StateSpaceModel:
        changed = choice
        for one, value in zip(parameters, values.tolist(), strict=True):
            changed = one.set(changed, value)
        return make_filter(changed.name, problem.model(**changed.model)).kernel_model

    def noise_at(values: np.ndarray, data: Data):
        pairs = [
            [model_at(values * np.exp(sign * step)) for sign in (1, -1)] for step in STEP * np.eye(len(values))
        ]
        for one, (above, below) in zip(parameters, pairs, strict=True):
            if not _differ_in_noise_alone(above, below):
                raise ValueError(
                    f"parameters of a gradient must change Q and R alone, but {one.name} changes more"
                )
        q, r = (
            np.array([(getattr(above, name) - getattr(below, name)) / (2 * STEP) for above, below in pairs])
            for name in ("process_noise_cov", "measurement_noise_cov")
        )
        return model_at(values), *_given(data), q, r

    return noise_at


def known_information(
    choice: Choice, scenarios: Sequence[Problem], data: Sequence[Data], names: Sequence[str], values: np.ndarray
) -> np.ndarray | None:
    """Fisher information on the logarithms of a Kalman filter's parameters in each of B runs, (B, p, p).

    None for other filters, and where a parameter changes more than Q and R. It takes the time of about fifteen
    runs of the filter; differences take two runs for each pair of parameters.

    Args:
        choice: choice of one filter type; its other parameters are held.
        scenarios: the problems.
        data: for each scenario, its runs.
        names: names of the p parameters.
        values: at which the information is taken, (p,).
    """
    if choice.name not in DIFFERENTIABLE or len(names) < LEAST_NUMBERS:
        return None
    found = []
    for scenario, one in zip(scenarios, data, strict=True):
        known = {parameter.name: parameter for parameter in model_parameters(scenario)}
        if not set(names) <= set(known):
            return None
        try:
            noise_at = noise_family(choice, scenario, [known[name] for name in names])
            in_runs = information(*noise_at(values, one))
            if scenario.leads_in and one.first_scored:  # the lead-in is left out
                in_runs = in_runs - information(*noise_at(values, one.beginning))
            found.append(in_runs)
        except ValueError:  # more than Q and R changes
            return None
    return np.concatenate(found)


def _variances(model: StateSpaceModel, parameters: Sequence[Parameter]) -> Callable:
    n, m, count = model.n, model.m, len(parameters)
    diagonal = np.append(np.diag(model.process_noise_cov), np.diag(model.measurement_noise_cov))
    places = [_index(one.place, n) for one in parameters]

    def noise_at(values: np.ndarray, data: Data):
        variances = diagonal.copy()
        variances[places] = values
        slopes = np.zeros((count, n + m, n + m))
        slopes[range(count), places, places] = values
        q, r = np.diag(variances[:n]), np.diag(variances[n:])
        changed = model.replace(process_noise_cov=q, measurement_noise_cov=r)
        return changed, *_given(data), slopes[:, :n, :n], slopes[:, n:, n:]

    return noise_at


def _given(data: Data) -> tuple[np.ndarray, np.ndarray]:
    """Inputs and measurements of a likelihood, to which a run's padding adds nothing."""
    seen = data.seen
    return seen.inputs, seen.measurements


def _index(place: Place, n: int) -> int:
    """The index of a variance in the diagonals of Q, (n,), then of R."""
    if isinstance(place, MeasurementVariance):
        return n + place.index
    if isinstance(place, ProcessVariance):
        return place.index
    raise TypeError(f"a parameter must be a variance of Q or R, but got {place}")


def _is_diagonal(cov: np.ndarray) -> bool:
    return np.array_equal(cov, np.diag(np.diag(cov)))


def _differ_in_noise_alone(one: StateSpaceModel, other: StateSpaceModel) -> bool:
    noise = {"process_noise_cov": one.process_noise_cov, "measurement_noise_cov": one.measurement_noise_cov}
    changed = other.replace(**noise)
    return changed.transition is one.transition and np.array_equal(changed.numbers, one.numbers)
