"""Search spaces: which numbers of a filter a study may choose, and how a choice becomes a filter."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import optuna

from filters.filter import Filter
from filters.registry import filter_class, make_filter, tunable_numbers
from tuning.scenarios import UNTUNED_ENSEMBLE_SIZE, Scenario

ENSEMBLE_SIZES = (5, 200)
Q_FACTORS = (1e-5, 1e2)  # range of each process noise variance, as factors on the untuned one
R_FACTORS = (1e-2, 1e3)  # range of the measurement noise variance, as factors on the sensor sheet's


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
    """The untuned filter: R from the sensor's sheet, Q from the ranges of the states, N = 30."""
    return Choice(name, scenario.untuned, _default_numbers(name))


def true_choice(name: str, scenario: Scenario) -> Choice:
    """The filter that is told the plant's own Q and R, with the untuned ensemble size."""
    return Choice(name, scenario.true, _default_numbers(name))


def has_ensemble(name: str) -> bool:
    """Whether a filter has an ensemble whose size can be chosen."""
    return "ensemble_size" in tunable_numbers(name)


def _default_numbers(name: str) -> dict:
    filter_class(name)  # a clear error for an unknown name
    return {"ensemble_size": UNTUNED_ENSEMBLE_SIZE} if has_ensemble(name) else {}


def suggest(trial: optuna.trial.BaseTrial, name: str, scenario: Scenario) -> Choice:
    """Let a trial choose: log-scaled Q for each state, R, and for ensembles N in 5 ... 200."""
    untuned = scenario.untuned
    q = []
    for number, variance in enumerate(untuned["process_noise_cov"], start=1):
        low, high = (variance * factor for factor in Q_FACTORS)
        q.append(trial.suggest_float(f"Q{number}{number}", low, high, log=True))
    low, high = (untuned["measurement_noise_cov"] * factor for factor in R_FACTORS)
    r = trial.suggest_float("R", low, high, log=True)
    numbers = {}
    if has_ensemble(name):
        numbers["ensemble_size"] = trial.suggest_int("N", *ENSEMBLE_SIZES, log=True)
    return Choice(name, {"process_noise_cov": tuple(q), "measurement_noise_cov": r}, numbers)


def parameters_of(choice: Choice) -> Mapping[str, float | int]:
    """The trial parameters that stand for a choice: the inverse of `suggest`."""
    q = {f"Q{i}{i}": value for i, value in enumerate(choice.model["process_noise_cov"], start=1)}
    n = {"N": choice.numbers["ensemble_size"]} if "ensemble_size" in choice.numbers else {}
    return {**q, "R": choice.model["measurement_noise_cov"], **n}


def choice_of(name: str, parameters: Mapping[str, float | int], scenario: Scenario) -> Choice:
    """The choice that trial parameters stand for."""
    return suggest(optuna.trial.FixedTrial(dict(parameters)), name, scenario)
