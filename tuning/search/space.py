"""Search spaces: which numbers of a filter a study may choose, and how a choice becomes a filter."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import optuna
from optuna.distributions import BaseDistribution, CategoricalDistribution, IntDistribution

from filters.estimators.find import is_foreign
from filters.filter import Filter
from filters.particles.weighted import WeightedFilter
from filters.registry import FILTERS, filter_class, make_filter, tunable_numbers
from tuning.problems.parameter import Parameter
from tuning.problems.problem import Problem
from tuning.search.parameters import (
    FilterNumber,
    filter_parameters,
    has_process_noise,
    model_parameters,
    places_in,
)

AUTO = "auto"  # stands for a filter that a study is to choose
# Among these: all that know how sure they are. The first one is the first trial.
AUTO_KINDS = ("ekf", *(name for name, kind in FILTERS.items() if kind.has_covariance and name != "ekf"))
KIND = "filter"  # the trial parameter that is the kind
SIZE_LADDER = (5, 7, 10, 14, 20, 30, 50, 70, 100, 140, 200, 300, 500, 700, 1000, 1400, 2000, 3000, 5000)


class Sizes(NamedTuple):
    """Ensemble sizes of a kind of filter."""

    untuned: int
    low: int  # of the search
    high: int


# The members of a Kalman ensemble make a mean and a covariance, those of a particle filter a whole distribution.
KALMAN_SIZES, PARTICLE_SIZES = Sizes(30, 5, 200), Sizes(1000, 200, 5000)


class Choice(NamedTuple):
    """One choice of a filter's free numbers."""

    name: str  # of the filter
    model: dict  # arguments of the problem's model, such as `process_noise_cov` and `measurement_noise_cov`
    numbers: dict  # the filter's own, such as `ensemble_size`

    def filter(self, problem: Problem) -> Filter:
        """The filter of this choice, with what the problem lets it assume of the plant."""
        return make_filter(self.name, problem.model(**self.model), **self.numbers)

    def with_size(self, ensemble_size: int) -> Choice:
        """The same choice with another ensemble size."""
        return self._replace(numbers={**self.numbers, "ensemble_size": ensemble_size})


def untuned_choice(name: str, problem: Problem) -> Choice:
    """The untuned filter: R from the sensor's sheet, Q from the ranges of the states, N = 30 (particles: 1000)."""
    return Choice(name, dict(problem.untuned), _default_numbers(name, problem))


def true_choice(name: str, problem: Problem) -> Choice | None:
    """The filter that is told the plant's own Q and R, with the untuned ensemble size; None if unknown."""
    return None if problem.true is None else Choice(name, dict(problem.true), _default_numbers(name, problem))


def has_ensemble(name: str) -> bool:
    """Whether a filter has an ensemble whose size can be chosen."""
    return "ensemble_size" in tunable_numbers(name)


def ensemble_sizes_of(name: str) -> Sizes:
    """Ensemble sizes of a filter that has an ensemble."""
    return PARTICLE_SIZES if issubclass(filter_class(name), WeightedFilter) else KALMAN_SIZES


def size_ladder(name: str) -> tuple[int, ...]:
    """Ensemble sizes of a filter at which a report shows its error, smallest first."""
    _, low, high = ensemble_sizes_of(name)
    return tuple(size for size in SIZE_LADDER if low <= size <= high)


def _default_numbers(name: str, problem: Problem) -> dict:
    own = _of_filter(name, has_process_noise(problem))
    if is_foreign(name):
        return {one.name: one.start for one in own}
    numbers = {"ensemble_size": ensemble_sizes_of(name).untuned} if has_ensemble(name) else {}
    others = [one.name for one in own if one.name != "N"]
    return numbers | {number: getattr(filter_class(name), number) for number in others}


def _of_filter(name: str, process_noise: bool = False) -> list[Parameter]:
    sizes = ensemble_sizes_of(name)[1:] if has_ensemble(name) else None
    return filter_parameters(name, sizes, process_noise)


def parameters(
    name: str, problem: Problem, *, hold_r: bool = False, full_q: bool = False, prior: bool = False
) -> list[Parameter]:
    """What a study may choose for a filter.

    Of the model that is what the problem says: by default Q for each state, R for each channel and, where asked
    for, the factor on P_0, all on logarithmic scales. Baselines, which know neither, keep the untuned ones.

    Args:
        name: of the filter.
        problem: the ranges are made of its untuned values.
        hold_r: leave R at the sensor's sheet.
        full_q: choose the correlations of Q, too.
        prior: choose the scale of P_0, too.
    """
    found = []
    if filter_class(name).has_covariance:
        found = model_parameters(problem, hold_r=hold_r, full_q=full_q, prior=prior)
    return found + _of_filter(name, has_process_noise(problem))


def distributions(name: str, problem: Problem, **options) -> dict[str, BaseDistribution]:
    """The ranges of `parameters` by name, as Optuna takes them."""
    return {one.name: one.distribution for one in parameters(name, problem, **options)}


def joint_parameters(kinds: Sequence[str], problem: Problem, **options) -> dict[str, Parameter]:
    """What a study may choose among several kinds of filters, by the names that trials have for it.

    What is of the model (Q, R, P_0) is shared by all kinds. Each kind's own numbers, such as "enkf N", are chosen
    only where that kind is. Of one kind these are its `parameters`.
    """
    found = {}
    for kind in kinds:
        for one in parameters(kind, problem, **options):
            own = isinstance(one.place, FilterNumber) and len(kinds) > 1
            found[f"{kind} {one.name}" if own else one.name] = one
    return found


def joint_distributions(kinds: Sequence[str], problem: Problem, **options) -> dict[str, BaseDistribution]:
    """The ranges of `joint_parameters`, as Optuna takes them; of several kinds, "filter" comes first."""
    found: dict[str, BaseDistribution] = {KIND: CategoricalDistribution(kinds)} if len(kinds) > 1 else {}
    return found | {key: one.distribution for key, one in joint_parameters(kinds, problem, **options).items()}


def _is_of(kind: str | None, key: str) -> bool:
    """Whether a parameter of `joint_distributions` is chosen for a kind."""
    return " " not in key or key.startswith(f"{kind} ")


def suggest(
    trial: optuna.trial.BaseTrial, name: str, problem: Problem, space: Mapping[str, BaseDistribution]
) -> Choice:
    """Let a trial choose all that a space of `joint_distributions` lists for the kind that it chooses."""
    chosen = {}
    for key, distribution in space.items():
        if isinstance(distribution, CategoricalDistribution):
            chosen[key] = trial.suggest_categorical(key, distribution.choices)
        elif _is_of(chosen.get(KIND), key):
            draw = trial.suggest_int if isinstance(distribution, IntDistribution) else trial.suggest_float
            chosen[key] = draw(key, distribution.low, distribution.high, log=distribution.log)
    return choice_of(name, chosen, problem)


def choice_of(name: str, values: Mapping[str, float | int | str], problem: Problem) -> Choice:
    """The choice that trial parameters stand for; what is not among them is that of the untuned filter.

    A filter named "auto" is the one that the parameter "filter" names.
    """
    if name == AUTO:
        name = values[KIND]
        values = {key.removeprefix(f"{name} "): value for key, value in values.items()}
    choice = untuned_choice(name, problem)
    if "N" not in values:
        choice.numbers.pop("ensemble_size", None)
    everything = {} if problem.parameters is not None else {"full_q": True, "prior": True}
    for one in parameters(name, problem, **everything):
        if one.name in values:
            choice = one.set(choice, values[one.name])
    return choice


def has_search_space(name: str) -> bool:
    """Whether there is anything to choose for a filter."""
    return filter_class(name).has_covariance or bool(_of_filter(name))


def parameters_of(choice: Choice) -> dict[str, float | int]:
    """The trial parameters that stand for a choice of one kind: the inverse of `choice_of`.

    Correlations and P0 are among them where the choice has a full Q and a factor on P_0.
    """
    places = places_in(choice) | {one.name: one.place for one in _of_filter(choice.name)}
    found = {name: place.get(choice) for name, place in places.items()}
    return {name: value for name, value in found.items() if value is not None}


def neutral(parameter: str) -> float | None:
    """What a trial parameter is where a choice lacks it: no correlation, P_0 as it is; None for all others."""
    return 1.0 if parameter == "P0" else 0.0 if parameter.startswith("correlation") else None


def trial_parameters(choice: Choice, space: Mapping[str, BaseDistribution]) -> dict[str, float | int | str]:
    """What a trial in a space of `joint_distributions` has to be given to make a choice."""
    own, found = parameters_of(choice), {}
    for key in space:
        if key == KIND:
            found[key] = choice.name
        elif _is_of(choice.name, key):
            short = key.removeprefix(f"{choice.name} ")
            found[key] = own.get(short, neutral(short))
    return found
