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


def null_of(coordinates: Coordinates, place: int, start: np.ndarray) -> tuple[float, bool]:
    """The coordinate at which a parameter is left out, and whether that is zero; otherwise it is the start."""
    one = coordinates.free[place]
    is_zero = not one.log and one.low <= 0.0 <= one.high
    return (0.0 if is_zero else float(start[place])), is_zero


def from_nothing(objective: Objective, start: np.ndarray, stop, tell) -> Ascent | None:
    """The maximum that is found from that with all effects left out that may be zero; None without any.

    So a further parameter never lowers the log-likelihood.
    """
    coordinates = objective.coordinates
    nulls = [null_of(coordinates, place, start) for place in range(len(start))]
    held = np.array([is_zero for _, is_zero in nulls])
    if not held.any() or held.all():
        return None
    at = np.where(held, [null for null, _ in nulls], start)
    bounds = coordinates.low, coordinates.high
    without = climb(objective, at, *bounds, held=held, stop=stop)
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
        made: dict[str, NullTest] = {}
        for place, name in enumerate(coordinates.names):
            if stop():
                return best, {}
            null, is_zero = null_of(coordinates, place, start)
            held = _held_at(objective, best, place, null, cov, stop)
            if held.found.value > best.found.value + BETTER:
                further = climb(objective, held.at, coordinates.low, coordinates.high, stop=stop)
                best = further if further.found.value > held.found.value else held
                break
            inflation = max(cov[place, place] / naive[place, place], 1.0)
            fall = max(best.found.value - held.found.value, 0.0)
            p = math.erfc(math.sqrt(fall / inflation))  # of 2 fall/inflation
            at_end = null <= coordinates.low[place] or null >= coordinates.high[place]
            value = float(coordinates.values(held.at)[place])
            made[name] = NullTest(value, is_zero, held.found.value, p / 2 if at_end and fall > 0 else p)
        else:
            return best, made
    return best, made


def _held_at(objective: Objective, best: Ascent, place: int, null: float, cov: np.ndarray, stop) -> Ascent:
    """The maximum with a parameter held; the others begin in the direction of their correlation with it."""
    coordinates = objective.coordinates
    bounds = coordinates.low, coordinates.high
    held = np.arange(len(best.at)) == place
    along = best.at + cov[:, place] / cov[place, place] * (null - best.at[place])
    starts = [np.clip(along, *bounds), np.array(best.at)]
    for at in starts:
        at[place] = null
    at = max(starts, key=objective.value)
    return climb(objective, at, *bounds, held=held, iterations=LEGS, stop=stop)
