"""A user's own parameters as a choice: those of a filter, or of a model with its own Q and R."""

from __future__ import annotations

from typing import Any

from filters.filter import Filter
from filters.registry import filter_type
from thruster_env.model.state_space import StateSpaceModel
from tuning.problems.assumed import as_argument, rows_argument
from tuning.problems.problem import Problem
from tuning.search.space import Choice, untuned_choice

DEFAULT_FILTER = "ekf"  # of a model alone


def is_own(given: Any) -> bool:
    """Whether something is a filter object or a model, with its own parameters."""
    return isinstance(given, Filter | StateSpaceModel)


def user_choice(given: Filter | StateSpaceModel, problem: Problem) -> Choice:
    """The Q, R and other parameters of a filter or model, with its prior, for a problem of the same equations.

    A model means an extended Kalman filter on it.

    Raises:
        ValueError: if the model's functions, states or constants are not those of the problem's.
    """
    model = given.model if isinstance(given, Filter) else given
    name = given.name if isinstance(given, Filter) else DEFAULT_FILTER
    expected = problem.model(**problem.untuned)
    if model.digest != expected.digest:
        raise ValueError(
            f"own numbers must be of the model of {problem.name}, digest {expected.digest}, but got a model of "
            f"digest {model.digest}: make a problem of it, ModelProblem(truth, model)"
        )
    noise = {
        "process_noise_cov": rows_argument(model.process_noise_cov),
        "measurement_noise_cov": as_argument(model.measurement_noise_cov),
    }
    numbers = untuned_choice(name, problem).numbers
    if isinstance(given, Filter):
        numbers = {
            key: getattr(given, key) for key in filter_type(name).numbers if key in numbers or hasattr(given, key)
        }
    return Choice(name, {**{one.name: one.start for one in problem.parameters or ()}, **noise}, numbers)
