"""Likelihood-ratio tests of each free parameter against leaving it out."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from tuning.identification.ascent import Ascent, climb
from tuning.identification.objective import Objective
from tuning.problems.parameter import Coordinates

LEGS = 25  # iterations of the other parameters, at most
ROUNDS = 4  # of going on from a better place that a test has found, at most
BETTER = 1e-3  # rise in log-likelihood that counts as one


class NullTest(NamedTuple):
    """The likelihood of the runs with a parameter held at its null instead of free."""

    at: float  # zero where its range holds it, else where the search began
    is_zero: bool
    log_likelihood: float  # the largest with all other parameters free
    p: float  # probability of a fall at least as large, if that were the truth

    @property
    def said(self) -> str:
        """The probability, for a table."""
        return "< 0.001" if self.p < 1e-3 else f"{self.p:.2g}"


def null_of(coordinates: Coordinates, index: int, start: np.ndarray) -> tuple[float, bool]:
    """The coordinate at which a parameter is left out, and whether that is zero; otherwise it is the start."""
    parameter = coordinates.free[index]
    is_zero = not parameter.log and parameter.low <= 0.0 <= parameter.high
    return (0.0 if is_zero else float(start[index])), is_zero


def from_nothing(objective: Objective, start: np.ndarray, stop, tell) -> Ascent | None:
    """The maximum that is found from that with all effects left out that may be zero; None without any.

    So a further parameter never lowers the log-likelihood.
    """
    coordinates = objective.coordinates
    nulls = [null_of(coordinates, index, start) for index in range(len(start))]
    fixed = np.array([is_zero for _, is_zero in nulls])
    if not fixed.any() or fixed.all():
        return None
    at = np.where(fixed, [null for null, _ in nulls], start)
    bounds = coordinates.low, coordinates.high
    without = climb(objective, at, *bounds, fixed=fixed, stop=stop)
    return climb(objective, without.at, *bounds, stop=stop, progress=tell)


def null_tests(
    objective: Objective,
    best: Ascent,
    start: np.ndarray,
    errors_of: Callable[[Ascent], tuple[np.ndarray, np.ndarray]],
    stop: Callable[[], bool],
) -> tuple[Ascent, dict[str, NullTest]]:
    """Hold each parameter at its null, maximise over the others, and compare; return the better maximum, too.

        D = 2 (log L - log L held)/lambda,  lambda = var(estimate)/(J^-1)

    is chi-squared with one degree of freedom if the null is true: with probability a half only, else zero, if the
    null is an end of the range. lambda is 1 where the model is right. If a search with a parameter held ends
    higher than the best one, the latter continues from there, and the tests start again.

    Args:
        objective: the log-likelihood.
        best: its maximum.
        start: coordinates (p,) of the start.
        errors_of: covariances (p, p) of the estimates at a maximum: those stated, and J^-1.
        stop: ends the tests, which are then none.

    Returns:
        The maximum, and the tests by name.

    Source: Kent (1982), "Robust properties of likelihood ratio tests", Biometrika 69(1); Chernoff (1954), "On the
    distribution of the likelihood ratio", for ends of ranges.
    """
    coordinates = objective.coordinates
    for _ in range(ROUNDS):
        cov, naive = errors_of(best)
        tests: dict[str, NullTest] = {}
        for index, name in enumerate(coordinates.names):
            if stop():
                return best, {}
            null, is_zero = null_of(coordinates, index, start)
            restricted = _held_at(objective, best, index, null, cov, stop)
            if restricted.found.value > best.found.value + BETTER:
                further = climb(objective, restricted.at, coordinates.low, coordinates.high, stop=stop)
                best = further if further.found.value > restricted.found.value else restricted
                break
            inflation = max(cov[index, index] / naive[index, index], 1.0)
            fall = max(best.found.value - restricted.found.value, 0.0)
            p = math.erfc(math.sqrt(fall / inflation))  # of 2 fall/inflation
            at_end = null <= coordinates.low[index] or null >= coordinates.high[index]
            value = float(coordinates.values(restricted.at)[index])
            tests[name] = NullTest(value, is_zero, restricted.found.value, p / 2 if at_end and fall > 0 else p)
        else:
            return best, tests
    return best, tests


def _held_at(objective: Objective, best: Ascent, index: int, null: float, cov: np.ndarray, stop) -> Ascent:
    """The maximum with a parameter held; the others begin in the direction of their correlation with it."""
    coordinates = objective.coordinates
    bounds = coordinates.low, coordinates.high
    fixed = np.arange(len(best.at)) == index
    along = best.at + cov[:, index] / cov[index, index] * (null - best.at[index])
    starts = [np.clip(along, *bounds), np.array(best.at)]
    for at in starts:
        at[index] = null
    at = max(starts, key=objective.value)
    return climb(objective, at, *bounds, fixed=fixed, iterations=LEGS, stop=stop)
