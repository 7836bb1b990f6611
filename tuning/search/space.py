"""Search spaces: the parameters of a filter that a study may choose, and the filter of a choice."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from math import ceil, floor, inf, isfinite, log10
from numbers import Real
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import optuna
from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution, IntDistribution

from filters.consistency.time_constants import (
    SHARE,
    RaisedNoise,
    Run,
    TimeConstants,
    forgetting_noise,
    slopes_along,
    time_constants,
)
from filters.consistency.time_constants import Path as GainPath
from filters.estimators.foreign import ForeignFilter, estimator_named, is_trained
from filters.filter import Filter
from filters.registry import FILTERS, FilterType, filter_type, make_filter
from filters.tuned_file import NOISE, PRIOR
from tuning.problems.assumed import constants_in, rows_argument
from tuning.problems.problem import Parameter, Problem
from tuning.search.parameters import (
    FilterParameter,
    ensemble_sizes_of,
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


def default_numbers(kind: FilterType, process_noise: bool) -> dict[str, Any]:
    """The values of these parameters in the untuned filter."""
    parameters = filter_parameters(kind, process_noise)
    if kind.is_foreign:
        return {parameter.name: parameter.start for parameter in parameters}
    size = {"ensemble_size": ensemble_sizes_of(kind).untuned} if kind.has_ensemble else {}
    return size | {
        parameter.name: getattr(kind.filter_class, parameter.name)
        for parameter in parameters
        if parameter.name != "N"
    }


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


TOLERANCE = 1.001  # of the longest time constant of a steady gain
MARGIN = 1.1  # of the next time constant that is tried over the one that a larger Q reached
ATTEMPTS = 8  # to find one that a larger Q reaches


def time_constants_on(filter_: Filter, problem: Problem, seed: int = 0) -> TimeConstants | None:
    """Time constants of a filter's gain along two training runs of a problem, of logs along whole logs.

    Constants of the model that are estimated without a random walk are not among them: these are to be remembered.

    Args:
        filter_: the filter; one of another package has none, as it need not compute with its model.
        problem: whose runs they are.
        seed: of the study.
    """
    if isinstance(filter_, ForeignFilter):
        return None
    fixed = _fixed(problem, filter_.kernel_model.process_noise_cov)
    constants = time_constants(filter_, _runs(problem, seed), fixed)
    return constants and constants._replace(length=problem.shortest_log or constants.length)


def forgetting(
    choice: Choice, problems: Sequence[Problem], seed: int, seconds: float, *, exact: bool = False
) -> Choice:
    """The choice with the least Q, from its own up, by which no time constant on problems exceeds some seconds.

    Where no Q is enough it is the best of those that were tried.

    Args:
        choice: of a filter with a covariance.
        problems: of models of one size; the path of each is that of an extended filter with the untuned Q and R.
        seed: of the study.
        seconds: the longest time constant that is allowed [s].
        exact: whether the time constants are those that results state, of the filter's own gains late in two
            runs, and not those of the steady gain along the path, which are computed faster.
    """
    for problem in problems:
        raised = raised_noise(choice, problem, seed, seconds, exact=exact)
        if raised is not None and not np.array_equal(raised.cov, problem.model(**choice.model).process_noise_cov):
            choice = _with_noise(choice, raised.cov)
    return choice


def raised_noise(
    choice: Choice, problem: Problem, seed: int, seconds: float, *, exact: bool = False
) -> RaisedNoise | None:
    """Q of a choice, raised so that it forgets within some seconds on a problem; None without a path or a dt.

    Arguments are those of `forgetting`.
    """
    parameters = {name: value for name, value in choice.model.items() if name not in (*NOISE, PRIOR)}
    path = _path(choice.name, problem, seed, tuple(sorted(parameters.items())))
    if path is None or problem.dt is None:
        return None

    def stated(cov: np.ndarray) -> float:
        constants = time_constants_on(_with_noise(choice, cov).filter(problem), problem, seed)
        return inf if constants is None else max(constants.steps, default=0.0)

    model = problem.model(**choice.model)
    fixed = _fixed(problem, model.process_noise_cov)
    return forgetting_noise(path, model, seconds / problem.dt, stated if exact else None, fixed)


def with_oracle_and_advice(constants: TimeConstants, choice: Choice, problem: Problem, seed: int) -> TimeConstants:
    """Time constants of a filter that sleeps, with those of the plant's own Q and R and a longest one to ask for.

    The advice is a fifth of a run, or more where a larger Q does not reach that: `--forget` accepts it, and the
    choice with a larger Q keeps it.
    """
    if not (constants.is_slow or constants.has_no_gain):
        return constants
    true = oracle_choice(choice.name, problem)
    true_constants = None if true is None else time_constants_on(true.filter(problem), problem, seed)
    if true_constants is not None and true_constants.steps:
        constants = constants._replace(oracle=(true_constants.steps[0], true_constants.uptake))
    if constants.is_slow and problem.dt is not None:
        fifth = max(_two_digits(SHARE * constants.length * problem.dt, floor), problem.dt)
        advised = reachable(choice.name, problem, seed, fifth, choice)
        if advised is not None and advised < constants.steps[0] * problem.dt:
            constants = constants._replace(advised=advised)
    return constants


def reachable(
    name: str, problem: Problem, seed: int, seconds: float, choice: Choice | None = None
) -> float | None:
    """A longest time constant [s], these seconds or a little more, that a larger Q reaches on a problem.

    Args:
        name: of the filter; `--forget` accepts what a larger Q than the untuned one reaches.
        problem: on which it forgets.
        seed: of the study.
        seconds: to begin with.
        choice: whose own gain has to reach it, too, with a larger Q; None if no choice has to.

    Returns:
        None where no Q reaches any of those that were tried, or the problem has no path or sample time.
    """
    asked = [(untuned_choice(name, problem), False), *([] if choice is None else [(choice, True)])]
    for _ in range(ATTEMPTS):
        raised = [raised_noise(candidate, problem, seed, seconds, exact=exact) for candidate, exact in asked]
        longest = max(inf if noise is None or problem.dt is None else noise.steps * problem.dt for noise in raised)
        if longest <= TOLERANCE * seconds:
            return seconds
        if not isfinite(longest):
            return None
        seconds = _two_digits(MARGIN * longest, ceil)
    return None


def _two_digits(value: float, rounding: Callable[[float], int]) -> float:
    exponent = floor(log10(value)) - 1
    return float(f"{rounding(float(f'{value / 10.0**exponent:.9g}'))}e{exponent}")


def _fixed(problem: Problem, cov: np.ndarray) -> tuple[int, ...]:
    """Indices of a model's constants (`--augment`), its last states, that have no random walk in Q (n, n)."""
    n = len(cov)
    return tuple(i for i in range(n - len(constants_in(problem)), n) if cov[i, i] == 0.0)


def _with_noise(choice: Choice, cov: np.ndarray) -> Choice:
    return choice._replace(model={**choice.model, NOISE[0]: rows_argument(cov)})


@lru_cache(maxsize=16)
def _runs(problem: Problem, seed: int) -> tuple[Run, ...]:
    return tuple(problem.long_runs(seed))


@lru_cache(maxsize=64)
def _path(name: str, problem: Problem, seed: int, parameters: tuple) -> GainPath | None:
    """Slopes of the model that a filter of this name assumes, along estimates with the untuned Q and R."""
    untuned = problem.model(**problem.untuned)
    model = problem.model(**dict(parameters)) if parameters else untuned
    model = model.replace(**{noise: getattr(untuned, noise) for noise in NOISE})
    used = make_filter("ekf", make_filter(name, model).kernel_model)
    return slopes_along(used, _runs(problem, seed))
