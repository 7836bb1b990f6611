"""Search spaces: the parameters of a filter that a study may choose, and the filter of a choice."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from numbers import Real
from typing import Any, NamedTuple

import optuna
from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution, IntDistribution

from filters.estimators.find import is_foreign
from filters.filter import Filter
from filters.particles.rao_blackwell import RaoBlackwellisedParticleFilter
from filters.particles.weighted import WeightedFilter
from filters.registry import FILTERS, filter_class, make_filter, tunable_numbers
from tuning.problems.parameter import Parameter
from tuning.problems.problem import Problem
from tuning.search.filter_parameters import FilterParameter, filter_parameters
from tuning.search.parameters import (
    has_process_noise,
    model_parameters,
    places_in,
)

AUTO = "auto"  # in place of a filter: a study chooses among the following, all filters with a covariance.
# The first one is the first trial.
AUTO_FILTER_TYPES = ("ekf", *(name for name, kind in FILTERS.items() if kind.has_covariance and name != "ekf"))
FILTER_TYPE = "filter"  # the trial parameter that is the filter type
SIZE_LADDER = (5, 7, 10, 14, 20, 30, 50, 70, 100, 140, 200, 300, 500, 700, 1000, 1400, 2000, 3000, 5000)


class Sizes(NamedTuple):
    """Ensemble sizes of a filter type."""

    untuned: int
    low: int  # of the search
    high: int


# The members of a Kalman ensemble represent a mean and a covariance, those of a particle filter a distribution.
KALMAN_SIZES, PARTICLE_SIZES, GAUSSIANS = Sizes(30, 5, 200), Sizes(1000, 200, 5000), Sizes(100, 20, 1000)


class Choice(NamedTuple):
    """One choice of a filter's free parameters."""

    name: str  # name of the filter
    model: dict[str, Any]  # arguments of the problem's model, such as `process_noise_cov`
    numbers: dict[str, Any]  # the filter's parameters, such as `ensemble_size`

    def filter(self, problem: Problem) -> Filter:
        """The filter of this choice, with the problem's assumed model."""
        return make_filter(self.name, problem.model(**self.model), **self.numbers)

    def with_size(self, ensemble_size: int) -> Choice:
        """The same choice with another ensemble size."""
        return self._replace(numbers={**self.numbers, "ensemble_size": ensemble_size})


def untuned_choice(name: str, problem: Problem) -> Choice:
    """The untuned filter: R from the data sheet, Q from the ranges of the states, N = 30 (particles: 1000)."""
    return Choice(name, dict(problem.untuned), _default_numbers(name, problem))


def given_choice(name: str, problem: Problem) -> Choice | None:
    """The filter with the model's given values and the untuned ensemble size; None if there are none."""
    return None if problem.given is None else Choice(name, dict(problem.given), _default_numbers(name, problem))


def oracle_choice(name: str, problem: Problem) -> Choice | None:
    """The filter with the plant's own Q and R and the untuned ensemble size; None if they are unknown."""
    return None if problem.true is None else Choice(name, dict(problem.true), _default_numbers(name, problem))


def has_ensemble(name: str) -> bool:
    """Whether a filter has an ensemble whose size can be chosen."""
    return "ensemble_size" in tunable_numbers(name)


def ensemble_sizes_of(name: str) -> Sizes:
    """Ensemble sizes of a filter that has an ensemble."""
    kind = filter_class(name)
    if issubclass(kind, RaoBlackwellisedParticleFilter):
        return GAUSSIANS
    return PARTICLE_SIZES if issubclass(kind, WeightedFilter) else KALMAN_SIZES


def size_ladder(name: str) -> tuple[int, ...]:
    """Ensemble sizes of a filter at which a report shows its error, smallest first."""
    _, low, high = ensemble_sizes_of(name)
    return tuple(size for size in SIZE_LADDER if low <= size <= high)


def _default_numbers(name: str, problem: Problem) -> dict:
    own = _of_filter(name, has_process_noise(problem))
    if is_foreign(name):  # also the default of a user's filter
        return {one.name: one.start for one in own}
    numbers: dict[str, Any] = {"ensemble_size": ensemble_sizes_of(name).untuned} if has_ensemble(name) else {}
    others = [one.name for one in own if one.name != "N"]
    return numbers | {number: getattr(filter_class(name), number) for number in others}


def _of_filter(name: str, process_noise: bool = False) -> list[Parameter]:
    sizes = ensemble_sizes_of(name)[1:] if has_ensemble(name) else None
    return filter_parameters(name, sizes, process_noise)


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
    found = model_parameters(problem, **options) if filter_class(name).has_covariance else []
    return found + _of_filter(name, has_process_noise(problem))


def distributions(name: str, problem: Problem, **options) -> dict[str, BaseDistribution]:
    """The ranges of `parameters` by name, as Optuna takes them."""
    return {one.name: one.distribution for one in parameters(name, problem, **options)}


def joint_parameters(filter_types: Sequence[str], problem: Problem, **options) -> dict[str, Parameter]:
    """The choices of a study among several filter types, by the names of the trials' parameters.

    Parameters of the model (Q, R, P_0) are shared by all filter types. The parameters of one type, such as
    "enkf N", are chosen only in trials of that type. For a single type these are its `parameters`.
    """
    found = {}
    for name in filter_types:
        for one in parameters(name, problem, **options):
            of_filter = isinstance(one.place, FilterParameter) and len(filter_types) > 1
            found[f"{name} {one.name}" if of_filter else one.name] = one
    return found


def joint_distributions(filter_types: Sequence[str], problem: Problem, **options) -> dict[str, BaseDistribution]:
    """The ranges of `joint_parameters`, as Optuna takes them; of several filter types, "filter" comes first."""
    found: dict[str, BaseDistribution] = {}
    if len(filter_types) > 1:
        found[FILTER_TYPE] = CategoricalDistribution(filter_types)
    return found | {
        key: one.distribution for key, one in joint_parameters(filter_types, problem, **options).items()
    }


def _is_of(filter_type: str | None, key: str) -> bool:
    """Whether a parameter of `joint_distributions` is chosen for a filter type."""
    return " " not in key or key.startswith(f"{filter_type} ")


def suggest(
    trial: optuna.trial.BaseTrial,
    name: str,
    problem: Problem,
    space: Mapping[str, BaseDistribution],
    where: Sequence[str] = (),
) -> Choice:
    """Let a trial choose its filter type, and the parameters of a `joint_distributions` space for that type."""
    chosen: dict[str, float | int | str] = {}
    filter_type = None
    for key, distribution in space.items():
        if isinstance(distribution, CategoricalDistribution):
            filter_type = str(trial.suggest_categorical(key, distribution.choices))
            chosen[key] = filter_type
        elif _is_of(filter_type, key):
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
    found = {}
    for name, value in parameters.items():
        if isinstance(value, Real):
            low, high = ends_of(space[name])
            value = min(max(value, low), high)
        found[name] = value
    return found


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
    for one in parameters(name, problem, **everything_of(problem), where=where):
        if one.name in values:
            choice = one.set(choice, values[one.name])
    return choice


def everything_of(problem: Problem) -> dict[str, Any]:
    """The options of `parameters` for all that a study of a problem may choose."""
    return {} if problem.parameters is not None else {"full_q": True, "full_r": True, "prior": True}


def has_search_space(name: str) -> bool:
    """Whether a filter has any parameter to choose."""
    return filter_class(name).has_covariance or bool(_of_filter(name))


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
    places = places_in(choice) | {one.name: one.place for one in _of_filter(choice.name)}
    found = {name: place.get(choice) for name, place in places.items()}
    return {name: value for name, value in found.items() if value is not None}


def neutral(parameter: str) -> float | None:
    """The value of a trial parameter that a choice lacks: no correlation, P_0 unchanged; None for all others."""
    return 1.0 if parameter == "P0" else 0.0 if "correlation_" in parameter else None


def trial_parameters(choice: Choice, space: Mapping[str, BaseDistribution]) -> dict[str, float | int | str]:
    """The parameters of a trial in a `joint_distributions` space that make a choice."""
    own = parameters_of(choice)
    found: dict[str, float | int | str] = {}
    for key in space:
        if key == FILTER_TYPE:
            found[key] = choice.name
        elif _is_of(choice.name, key):
            short = key.removeprefix(f"{choice.name} ")
            value = own.get(short, neutral(short))
            if value is None:
                raise ValueError(f"a trial must have a value of {key}, but the choice has none")
            found[key] = value
    return found
