"""Search spaces: the parameters of a filter that a study may choose, and the filter of a choice."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from numbers import Real
from pathlib import Path
from typing import Any, NamedTuple

import optuna
from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution, IntDistribution

from filters.estimators.find import estimator_named, is_trained
from filters.filter import Filter
from filters.registry import FILTERS, filter_type, make_filter
from tuning.problems.problem import Parameter, Problem
from tuning.search.parameters import (
    FilterParameter,
    default_numbers,
    filter_parameters,
    has_process_noise,
    model_parameters,
    places_in,
)

AUTO = "auto"  # in place of a filter: a study chooses among the following, all filters with a covariance.
# The first one is the first trial.
AUTO_FILTER_TYPES = ("ekf", *(name for name, kind in FILTERS.items() if kind.has_covariance and name != "ekf"))
FILTER_TYPE = "filter"  # the trial parameter that is the filter type


class Choice(NamedTuple):
    """One choice of a filter's free parameters."""

    name: str  # name of the filter
    model: dict[str, Any]  # arguments of the problem's model, such as `process_noise_cov`
    numbers: dict[str, Any]  # the filter's parameters, such as `ensemble_size`

    def filter(self, problem: Problem) -> Filter:
        """The filter of this choice, with the problem's assumed model."""
        try:
            model = problem.started_for(self.name, problem.model(**self.model))
            return make_filter(self.name, model, **self.numbers)
        except ValueError:
            if is_trained(self.name) and Path(self.name).is_file():  # what differs, by the presets' names
                problem.check_tuned_for(estimator_named(self.name).training.get("plant"), self.name)
            raise

    def with_size(self, ensemble_size: int) -> Choice:
        """The same choice with another ensemble size."""
        return self._replace(numbers={**self.numbers, "ensemble_size": ensemble_size})


def untuned_choice(name: str, problem: Problem) -> Choice:
    """The untuned filter: R from the data sheet, Q from the ranges of the states, N = 30 (particles: 1000)."""
    return _choice(name, problem, problem.untuned)


def given_choice(name: str, problem: Problem) -> Choice | None:
    """The filter with the model's given values and the untuned ensemble size; None if there are none."""
    return None if problem.given is None else _choice(name, problem, problem.given)


def oracle_choice(name: str, problem: Problem) -> Choice | None:
    """The filter with the plant's own Q and R and the untuned ensemble size; None if they are unknown."""
    return None if problem.true is None else _choice(name, problem, problem.true)


def _choice(name: str, problem: Problem, model: Mapping[str, Any]) -> Choice:
    return Choice(name, dict(model), default_numbers(filter_type(name), has_process_noise(problem)))


def parameters(name: str, problem: Problem, **options: Any) -> list[Parameter]:
    """The parameters that a study may choose for a filter.

    Those of the model are defined by the problem: by default a variance in Q for each state, a variance in R for
    each channel and, where requested, the factor on P_0, all on logarithmic scales. Filters without a covariance
    have no parameters of the model.

    Args:
        name: name of the filter.
        problem: the ranges follow from its untuned values.
        **options: of `model_parameters`, what of the model is chosen.
    """
    kind = filter_type(name)
    of_model = model_parameters(problem, **options) if kind.has_covariance else []
    return of_model + filter_parameters(kind, has_process_noise(problem))


def distributions(name: str, problem: Problem, **options) -> dict[str, BaseDistribution]:
    """The ranges of `parameters` by name, as Optuna takes them."""
    return {parameter.name: parameter.distribution for parameter in parameters(name, problem, **options)}


def joint_parameters(filter_types: Sequence[str], problem: Problem, **options) -> dict[str, Parameter]:
    """The choices of a study among several filter types, by the names of the trials' parameters.

    Parameters of the model (Q, R, P_0) are shared by all filter types. The parameters of one type, such as
    "enkf N", are chosen only in trials of that type. For a single type these are its `parameters`.
    """
    by_name = {}
    for name in filter_types:
        for parameter in parameters(name, problem, **options):
            of_filter = isinstance(parameter.place, FilterParameter) and len(filter_types) > 1
            by_name[f"{name} {parameter.name}" if of_filter else parameter.name] = parameter
    return by_name


def joint_distributions(filter_types: Sequence[str], problem: Problem, **options) -> dict[str, BaseDistribution]:
    """The ranges of `joint_parameters`, as Optuna takes them; of several filter types, "filter" comes first."""
    space: dict[str, BaseDistribution] = {}
    if len(filter_types) > 1:
        space[FILTER_TYPE] = CategoricalDistribution(filter_types)
    return space | {
        key: parameter.distribution
        for key, parameter in joint_parameters(filter_types, problem, **options).items()
    }


def _is_of(name: str | None, key: str) -> bool:
    """Whether a parameter of `joint_distributions` is chosen for a filter type."""
    return " " not in key or key.startswith(f"{name} ")


def suggest(
    trial: optuna.trial.BaseTrial,
    name: str,
    problem: Problem,
    space: Mapping[str, BaseDistribution],
    where: Sequence[str] = (),
) -> Choice:
    """Let a trial choose its filter type, and the parameters of a `joint_distributions` space for that type."""
    chosen: dict[str, float | int | str] = {}
    chosen_type = None
    for key, distribution in space.items():
        if isinstance(distribution, CategoricalDistribution):
            chosen_type = str(trial.suggest_categorical(key, distribution.choices))
            chosen[key] = chosen_type
        elif _is_of(chosen_type, key):
            if isinstance(distribution, IntDistribution):
                chosen[key] = trial.suggest_int(key, distribution.low, distribution.high, log=distribution.log)
            elif isinstance(distribution, FloatDistribution):
                chosen[key] = trial.suggest_float(key, distribution.low, distribution.high, log=distribution.log)
    return choice_of(name, chosen, problem, where)


def ends_of(distribution: BaseDistribution) -> tuple[float, float]:
    """The smallest and the largest value of a parameter; TypeError for a choice among names."""
    if not isinstance(distribution, FloatDistribution | IntDistribution):
        raise TypeError(f"only a range of numbers has ends, but got {distribution}")
    return distribution.low, distribution.high


def within_ranges(parameters: Mapping, space: Mapping[str, BaseDistribution]) -> dict:
    """The parameters of a trial, those that are numbers moved into their ranges."""
    clipped = {}
    for name, value in parameters.items():
        if isinstance(value, Real):
            low, high = ends_of(space[name])
            value = min(max(value, low), high)
        clipped[name] = value
    return clipped


def choice_of(
    name: str, values: Mapping[str, float | int | str], problem: Problem, where: Sequence[str] = ()
) -> Choice:
    """The choice of a trial's parameters; missing parameters are those of the untuned filter.

    It obeys the relations `where`.

    For the name "auto" the parameter "filter" names the filter.
    """
    if name == AUTO:
        name = str(values[FILTER_TYPE])
        values = {key.removeprefix(f"{name} "): value for key, value in values.items()}
    choice = untuned_choice(name, problem)
    if "N" not in values:
        choice.numbers.pop("ensemble_size", None)
    for parameter in parameters(name, problem, **everything_of(problem), where=where):
        if parameter.name in values:
            choice = parameter.set(choice, values[parameter.name])
    return choice


def everything_of(problem: Problem) -> dict[str, Any]:
    """The options of `parameters` for all that a study of a problem may choose."""
    return {} if problem.parameters is not None else {"full_q": True, "full_r": True, "prior": True}


def has_search_space(name: str) -> bool:
    """Whether a filter has any parameter to choose."""
    kind = filter_type(name)
    return kind.has_covariance or bool(filter_parameters(kind, process_noise=False))


@lru_cache(maxsize=512)
def fits(name: str, problem: Problem) -> bool:
    """Whether a filter can be made on a problem: `kf`, say, needs an affine model or an operating point."""
    try:
        untuned_choice(name, problem).filter(problem)
    except ValueError:
        return False
    return True


def parameters_of(choice: Choice) -> dict[str, float | int]:
    """The trial parameters of a choice of one filter type: the inverse of `choice_of`.

    Correlations and P0 are among them where the choice has a full Q or R and a factor on P_0.
    """
    locations = places_in(choice) | {
        parameter.name: parameter.place
        for parameter in filter_parameters(filter_type(choice.name), process_noise=False)
    }
    values = {name: location.get(choice) for name, location in locations.items()}
    return {name: value for name, value in values.items() if value is not None}


def neutral(parameter: str) -> float | None:
    """The value of a trial parameter that a choice lacks: no correlation, P_0 unchanged; None for all others."""
    return 1.0 if parameter == "P0" else 0.0 if "correlation_" in parameter else None


def trial_parameters(choice: Choice, space: Mapping[str, BaseDistribution]) -> dict[str, float | int | str]:
    """The parameters of a trial in a `joint_distributions` space that make a choice."""
    of_choice = parameters_of(choice)
    values: dict[str, float | int | str] = {}
    for key in space:
        if key == FILTER_TYPE:
            values[key] = choice.name
        elif _is_of(choice.name, key):
            short = key.removeprefix(f"{choice.name} ")
            value = of_choice.get(short, neutral(short))
            if value is None:
                raise ValueError(f"a trial must have a value of {key}, but the choice has none")
            values[key] = value
    return values
