"""How long a filter remembers on a problem, and choices whose Q is raised so that it forgets in time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from math import ceil, floor, inf, isfinite, log10

import numpy as np

from filters.consistency.time_constants import (
    SHARE,
    Path,
    RaisedNoise,
    Run,
    TimeConstants,
    forgetting_noise,
    slopes_along,
    time_constants,
)
from filters.estimators.foreign import ForeignFilter
from filters.filter import Filter
from filters.registry import make_filter
from filters.tuned_file import NOISE, PRIOR
from tuning.problems.assumed import constants_in, rows_argument
from tuning.problems.problem import Problem
from tuning.search.space import Choice, oracle_choice, untuned_choice

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
    """A positive number with two digits."""
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
    """Two training runs."""
    return tuple(problem.long_runs(seed))


@lru_cache(maxsize=64)
def _path(name: str, problem: Problem, seed: int, parameters: tuple) -> Path | None:
    """Slopes of the model that a filter of this name assumes, along estimates with the untuned Q and R."""
    untuned = problem.model(**problem.untuned)
    model = problem.model(**dict(parameters)) if parameters else untuned
    model = model.replace(**{noise: getattr(untuned, noise) for noise in NOISE})
    used = make_filter("ekf", make_filter(name, model).kernel_model)
    return slopes_along(used, _runs(problem, seed))
