"""Search spaces: which numbers of a filter a study may choose, and how a choice becomes a filter."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import optuna
from optuna.distributions import BaseDistribution, FloatDistribution, IntDistribution

from filters.filter import Filter
from filters.particles.weighted import WeightedFilter
from filters.registry import filter_class, make_filter, tunable_numbers
from tuning.scenario import Scenario

Q_FACTORS = (1e-5, 1e2)  # range of each process noise variance, as factors on the untuned one
R_FACTORS = (1e-2, 1e3)  # range of the measurement noise variance, as factors on the sensor sheet's
# Ranges of numbers that filters have beside Q, R and N; they hold the defaults of all filters.
OWN_NUMBERS: dict[str, BaseDistribution] = {
    "inflation": FloatDistribution(1.0, 1.3),
    "relaxation": FloatDistribution(0.0, 0.9),
    "iterations": IntDistribution(1, 8),
    "alpha": FloatDistribution(0.05, 2.0, log=True),
    "resampling_threshold": FloatDistribution(0.1, 1.0),
    "forgetting_factor": FloatDistribution(0.9, 0.9999),
    "prior_weight": FloatDistribution(1.0, 100.0, log=True),
    "degrees_of_freedom": FloatDistribution(2.5, 50.0, log=True),
    "time_constant": FloatDistribution(0.2, 50.0, log=True),  # in steps
}
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
    model: dict  # `process_noise_cov` and `measurement_noise_cov`
    numbers: dict  # the filter's own, such as `ensemble_size`

    def filter(self, scenario: Scenario) -> Filter:
        """The filter of this choice, with what the scenario lets it assume of the plant."""
        return make_filter(self.name, scenario.model(**self.model), **self.numbers)

    def with_size(self, ensemble_size: int) -> Choice:
        """The same choice with another ensemble size."""
        return self._replace(numbers={**self.numbers, "ensemble_size": ensemble_size})


def untuned_choice(name: str, scenario: Scenario) -> Choice:
    """The untuned filter: R from the sensor's sheet, Q from the ranges of the states, N = 30 (particles: 1000)."""
    return Choice(name, scenario.untuned, _default_numbers(name))


def true_choice(name: str, scenario: Scenario) -> Choice:
    """The filter that is told the plant's own Q and R, with the untuned ensemble size."""
    return Choice(name, scenario.true, _default_numbers(name))


def has_ensemble(name: str) -> bool:
    """Whether a filter has an ensemble whose size can be chosen."""
    return "ensemble_size" in tunable_numbers(name)


def own_numbers(name: str) -> dict[str, BaseDistribution]:
    """Ranges of the numbers that a study may choose for a filter beside Q, R and N."""
    known = tunable_numbers(name)
    return {number: distribution for number, distribution in OWN_NUMBERS.items() if number in known}


def ensemble_sizes_of(name: str) -> Sizes:
    """Ensemble sizes of a filter that has an ensemble."""
    return PARTICLE_SIZES if issubclass(filter_class(name), WeightedFilter) else KALMAN_SIZES


def size_ladder(name: str) -> tuple[int, ...]:
    """Ensemble sizes of a filter at which a report shows its error, smallest first."""
    _, low, high = ensemble_sizes_of(name)
    return tuple(size for size in SIZE_LADDER if low <= size <= high)


def _default_numbers(name: str) -> dict:
    numbers = {"ensemble_size": ensemble_sizes_of(name).untuned} if has_ensemble(name) else {}
    return numbers | {number: getattr(filter_class(name), number) for number in own_numbers(name)}


def distributions(name: str, scenario: Scenario, *, hold_r: bool = False) -> dict[str, BaseDistribution]:
    """What a study may choose for a filter, by the names of its trials' parameters.

    Q for each state, R and N are chosen on logarithmic scales. Baselines, which know neither Q nor R, keep the
    untuned ones; with `hold_r` R stays that of the sensor's sheet.
    """
    untuned, found = scenario.untuned, {}
    if filter_class(name).has_covariance:
        pairs = zip(untuned["process_noise_cov"], scenario.scale, strict=True)
        for number, (variance, scale) in enumerate(pairs, start=1):
            # Where the voltage hardly moves a state, noise may move it more.
            low, high = Q_FACTORS[0] * variance, Q_FACTORS[1] * max(variance, scale**2)
            found[f"Q{number}{number}"] = FloatDistribution(low, high, log=True)
        if not hold_r:
            low, high = (untuned["measurement_noise_cov"] * factor for factor in R_FACTORS)
            found["R"] = FloatDistribution(low, high, log=True)
    if has_ensemble(name):
        _, low, high = ensemble_sizes_of(name)
        found["N"] = IntDistribution(low, high, log=True)
    return found | own_numbers(name)


def suggest(
    trial: optuna.trial.BaseTrial, name: str, scenario: Scenario, space: Mapping[str, BaseDistribution]
) -> Choice:
    """Let a trial choose all that a space of `distributions` lists."""
    chosen = {}
    for key, distribution in space.items():
        draw = trial.suggest_int if isinstance(distribution, IntDistribution) else trial.suggest_float
        chosen[key] = draw(key, distribution.low, distribution.high, log=distribution.log)
    return choice_of(name, chosen, scenario)


def choice_of(name: str, parameters: Mapping[str, float | int], scenario: Scenario) -> Choice:
    """The choice that trial parameters stand for; Q or R that are not among them are the untuned ones."""
    model = dict(scenario.untuned)
    if "Q11" in parameters:
        states = range(1, len(model["process_noise_cov"]) + 1)
        model["process_noise_cov"] = tuple(parameters[f"Q{number}{number}"] for number in states)
    model["measurement_noise_cov"] = parameters.get("R", model["measurement_noise_cov"])
    numbers = {"ensemble_size": parameters["N"]} if "N" in parameters else {}
    return Choice(name, model, numbers | {number: parameters[number] for number in own_numbers(name)})


def has_search_space(name: str) -> bool:
    """Whether there is anything to choose for a filter."""
    return filter_class(name).has_covariance or has_ensemble(name) or bool(own_numbers(name))


def parameters_of(choice: Choice) -> Mapping[str, float | int]:
    """The trial parameters that stand for a choice: the inverse of `suggest`."""
    parameters = {}
    if filter_class(choice.name).has_covariance:
        parameters = {f"Q{i}{i}": value for i, value in enumerate(choice.model["process_noise_cov"], start=1)}
        parameters["R"] = choice.model["measurement_noise_cov"]
    if "ensemble_size" in choice.numbers:
        parameters["N"] = choice.numbers["ensemble_size"]
    return parameters | {number: choice.numbers[number] for number in own_numbers(choice.name)}
