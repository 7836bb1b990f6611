"""Search spaces: which numbers of a filter a study may choose, and how a choice becomes a filter."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import optuna

from filters.filter import Filter
from filters.particles.weighted import WeightedFilter
from filters.registry import filter_class, make_filter, tunable_numbers
from tuning.scenario import Scenario

Q_FACTORS = (1e-5, 1e2)  # range of each process noise variance, as factors on the untuned one
R_FACTORS = (1e-2, 1e3)  # range of the measurement noise variance, as factors on the sensor sheet's
TIME_CONSTANTS = (0.2, 50.0)  # range of a low-pass filter's, in steps
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


def has_time_constant(name: str) -> bool:
    """Whether a filter is a low-pass filter, whose time constant can be chosen."""
    return "time_constant" in tunable_numbers(name)


def ensemble_sizes_of(name: str) -> Sizes:
    """Ensemble sizes of a filter that has an ensemble."""
    return PARTICLE_SIZES if issubclass(filter_class(name), WeightedFilter) else KALMAN_SIZES


def size_ladder(name: str) -> tuple[int, ...]:
    """Ensemble sizes of a filter at which a report shows its error, smallest first."""
    _, low, high = ensemble_sizes_of(name)
    return tuple(size for size in SIZE_LADDER if low <= size <= high)


def _default_numbers(name: str) -> dict:
    numbers = {"ensemble_size": ensemble_sizes_of(name).untuned} if has_ensemble(name) else {}
    return numbers | ({"time_constant": filter_class(name).time_constant} if has_time_constant(name) else {})


def suggest(trial: optuna.trial.BaseTrial, name: str, scenario: Scenario) -> Choice:
    """Let a trial choose, all on a logarithmic scale: Q for each state, R, and for ensembles N.

    Baselines, which know neither Q nor R, keep the untuned ones; a low-pass filter has a time constant to choose.
    """
    model, numbers = scenario.untuned, {}
    if filter_class(name).has_covariance:
        q = []
        for number, variance in enumerate(model["process_noise_cov"], start=1):
            low, high = (variance * factor for factor in Q_FACTORS)
            q.append(trial.suggest_float(f"Q{number}{number}", low, high, log=True))
        low, high = (model["measurement_noise_cov"] * factor for factor in R_FACTORS)
        model = {
            "process_noise_cov": tuple(q),
            "measurement_noise_cov": trial.suggest_float("R", low, high, log=True),
        }
    if has_ensemble(name):
        _, low, high = ensemble_sizes_of(name)
        numbers["ensemble_size"] = trial.suggest_int("N", low, high, log=True)
    if has_time_constant(name):
        numbers["time_constant"] = trial.suggest_float("time_constant", *TIME_CONSTANTS, log=True)
    return Choice(name, model, numbers)


def has_search_space(name: str) -> bool:
    """Whether there is anything to choose for a filter."""
    return filter_class(name).has_covariance or has_ensemble(name) or has_time_constant(name)


def parameters_of(choice: Choice) -> Mapping[str, float | int]:
    """The trial parameters that stand for a choice: the inverse of `suggest`."""
    parameters = {}
    if filter_class(choice.name).has_covariance:
        parameters = {f"Q{i}{i}": value for i, value in enumerate(choice.model["process_noise_cov"], start=1)}
        parameters["R"] = choice.model["measurement_noise_cov"]
    names = {"ensemble_size": "N", "time_constant": "time_constant"}
    return parameters | {names[key]: value for key, value in choice.numbers.items() if key in names}


def choice_of(name: str, parameters: Mapping[str, float | int], scenario: Scenario) -> Choice:
    """The choice that trial parameters stand for."""
    return suggest(optuna.trial.FixedTrial(dict(parameters)), name, scenario)
