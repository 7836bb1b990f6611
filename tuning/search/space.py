"""Search spaces: which numbers of a filter a study may choose, and how a choice becomes a filter."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import optuna
from optuna.distributions import (
    BaseDistribution,
    CategoricalDistribution,
    FloatDistribution,
    IntDistribution,
)

from filters.filter import Filter
from filters.particles.weighted import WeightedFilter
from filters.registry import FILTERS, filter_class, make_filter, tunable_numbers
from tuning.search.correlations import correlations_of, full_covariance
from tuning.thruster.scenario import Scenario

Q_FACTORS = (1e-5, 1e2)  # range of each process noise variance, as factors on the untuned one
R_FACTORS = (1e-2, 1e3)  # range of the measurement noise variance, as factors on the sensor sheet's
CORRELATIONS = (-0.99, 0.99)  # range of each correlation in a full Q
PRIOR_FACTORS = (1e-4, 1e2)  # range of P_0, as a factor on the covariance of the plant's initial state
AUTO = "auto"  # stands for a filter that a study is to choose
# Among these: all that know how sure they are. The first one is the first trial.
AUTO_KINDS = ("ekf", *(name for name, kind in FILTERS.items() if kind.has_covariance and name != "ekf"))
KIND = "filter"  # the trial parameter that is the kind
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
    model: dict  # `process_noise_cov`, `measurement_noise_cov` and, where it is chosen, `prior_cov_factor`
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


def distributions(
    name: str, scenario: Scenario, *, hold_r: bool = False, full_q: bool = False, prior: bool = False
) -> dict[str, BaseDistribution]:
    """What a study may choose for a filter, by the names of its trials' parameters.

    Q for each state, R, N and the factor on P_0 are chosen on logarithmic scales. Baselines, which know neither Q
    nor R, keep the untuned ones.

    Args:
        name: of the filter.
        scenario: the ranges are made of its untuned values.
        hold_r: leave R at the sensor's sheet.
        full_q: choose the correlations of Q, too (`correlations.full_covariance`).
        prior: choose the scale of P_0, too.
    """
    found = {}
    if filter_class(name).has_covariance:
        found = _model_distributions(scenario, hold_r=hold_r, full_q=full_q, prior=prior)
    if has_ensemble(name):
        _, low, high = ensemble_sizes_of(name)
        found["N"] = IntDistribution(low, high, log=True)
    return found | own_numbers(name)


def _model_distributions(
    scenario: Scenario, *, hold_r: bool, full_q: bool, prior: bool
) -> dict[str, BaseDistribution]:
    untuned, found = scenario.untuned, {}
    variances = untuned["process_noise_cov"]
    for number, (variance, scale) in enumerate(zip(variances, scenario.scale, strict=True), start=1):
        # Where the voltage hardly moves a state, noise may move it more.
        low, high = Q_FACTORS[0] * variance, Q_FACTORS[1] * max(variance, scale**2)
        found[f"Q{number}{number}"] = FloatDistribution(low, high, log=True)
    if full_q:
        found |= dict.fromkeys(_correlation_names(len(variances)), FloatDistribution(*CORRELATIONS))
    if not hold_r:
        low, high = (untuned["measurement_noise_cov"] * factor for factor in R_FACTORS)
        found["R"] = FloatDistribution(low, high, log=True)
    if prior:
        found["P0"] = FloatDistribution(*PRIOR_FACTORS, log=True)
    return found


def _correlation_names(states: int) -> list[str]:
    """Trial parameters that are correlations of Q, in the order of `correlations.full_covariance`."""
    return [f"correlation_{j}{i}" for i in range(2, states + 1) for j in range(1, i)]


def joint_distributions(kinds: Sequence[str], scenario: Scenario, **options) -> dict[str, BaseDistribution]:
    """What a study may choose among several kinds of filters; of one kind, its `distributions`.

    The parameter "filter" is the kind. What is of the model (Q, R, P_0) is shared by all kinds. Each kind's own
    numbers, such as "enkf N", are chosen only where that kind is.

    Args:
        kinds: names of filters.
        scenario: as for `distributions`; so are the options.
        **options: `hold_r`, `full_q`, `prior`.
    """
    spaces = {kind: distributions(kind, scenario, **options) for kind in kinds}
    if len(kinds) == 1:
        return spaces[kinds[0]]
    found: dict[str, BaseDistribution] = {KIND: CategoricalDistribution(kinds)}
    for kind, space in spaces.items():
        own = {"N", *own_numbers(kind)}
        found |= {f"{kind} {key}" if key in own else key: value for key, value in space.items()}
    return found


def _is_of(kind: str | None, key: str) -> bool:
    """Whether a parameter of `joint_distributions` is chosen for a kind."""
    return " " not in key or key.startswith(f"{kind} ")


def suggest(
    trial: optuna.trial.BaseTrial, name: str, scenario: Scenario, space: Mapping[str, BaseDistribution]
) -> Choice:
    """Let a trial choose all that a space of `joint_distributions` lists for the kind that it chooses."""
    chosen = {}
    for key, distribution in space.items():
        if isinstance(distribution, CategoricalDistribution):
            chosen[key] = trial.suggest_categorical(key, distribution.choices)
        elif _is_of(chosen.get(KIND), key):
            draw = trial.suggest_int if isinstance(distribution, IntDistribution) else trial.suggest_float
            chosen[key] = draw(key, distribution.low, distribution.high, log=distribution.log)
    return choice_of(name, chosen, scenario)


def choice_of(name: str, parameters: Mapping[str, float | int | str], scenario: Scenario) -> Choice:
    """The choice that trial parameters stand for; Q or R that are not among them are the untuned ones.

    A filter named "auto" is the one that the parameter "filter" names.
    """
    if name == AUTO:
        name = parameters[KIND]
        parameters = {key.removeprefix(f"{name} "): value for key, value in parameters.items()}
    model = dict(scenario.untuned)
    if "Q11" in parameters:
        states = range(1, len(model["process_noise_cov"]) + 1)
        variances = tuple(parameters[f"Q{number}{number}"] for number in states)
        names = _correlation_names(len(states))
        if names[0] in parameters:
            q = full_covariance(variances, [parameters[key] for key in names])
            variances = tuple(map(tuple, q.tolist()))
        model["process_noise_cov"] = variances
    model["measurement_noise_cov"] = parameters.get("R", model["measurement_noise_cov"])
    if "P0" in parameters:
        model["prior_cov_factor"] = parameters["P0"]
    numbers = {"ensemble_size": parameters["N"]} if "N" in parameters else {}
    return Choice(name, model, numbers | {number: parameters[number] for number in own_numbers(name)})


def has_search_space(name: str) -> bool:
    """Whether there is anything to choose for a filter."""
    return filter_class(name).has_covariance or has_ensemble(name) or bool(own_numbers(name))


def parameters_of(choice: Choice) -> Mapping[str, float | int]:
    """The trial parameters that stand for a choice of one kind: the inverse of `suggest`.

    Correlations and P0 are among them where the choice has a full Q and a factor on P_0.
    """
    parameters = {}
    if filter_class(choice.name).has_covariance:
        q = np.asarray(choice.model["process_noise_cov"])
        variances = q if q.ndim == 1 else np.diag(q)
        parameters = {f"Q{i}{i}": float(value) for i, value in enumerate(variances, start=1)}
        if q.ndim == 2:
            parameters |= zip(_correlation_names(len(q)), correlations_of(q), strict=True)
        parameters["R"] = choice.model["measurement_noise_cov"]
        if "prior_cov_factor" in choice.model:
            parameters["P0"] = choice.model["prior_cov_factor"]
    if "ensemble_size" in choice.numbers:
        parameters["N"] = choice.numbers["ensemble_size"]
    own = own_numbers(choice.name)
    return parameters | {number: value for number, value in choice.numbers.items() if number in own}


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
