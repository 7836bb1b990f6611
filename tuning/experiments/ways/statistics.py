"""Regrets of ways with intervals over data sets, and which ways are significantly worse than the best."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np

from filters.consistency.intervals import Interval
from tuning.experiments.users.significance import holm
from tuning.experiments.ways.entries import Result, Scored
from tuning.experiments.ways.problems import Case
from tuning.experiments.ways.protocol import REFERENCE

LEVEL = 0.05
EQUAL = 0.01  # of log ratios: "equal" is within 1 %


def within(kind: str, key: str) -> Callable[[Result], Scored | None]:
    """What of a result counts: what the way gave for a budget of "by_runs" or "by_seconds"."""
    return lambda one: getattr(one, kind).get(key)


class Regret(NamedTuple):
    """A way on the data sets of a case."""

    way: str
    ratio: (
        Interval  # score over that of the best constant numbers: mean of logarithms with Student's 95 % interval
    )
    median: float
    worst: float
    nees: float  # median over data sets, over the number of states
    nis: float
    log_score: float  # mean loss a step against the best constant numbers of least error [nat]
    failures: int
    sets: int
    runs: float  # median of what it took
    seconds: float
    worse: bool = False  # significantly worse than the best way of the case, by Holm's procedure at 5 %

    @property
    def equal(self) -> bool:
        """Whether it is equal to the best constant numbers: within 1 % for sure."""
        return self.ratio.low > math.exp(-EQUAL) and self.ratio.high < math.exp(EQUAL)


def regrets(
    results: Sequence[Result], case: Case, at: Callable[[Result], Scored | None] = lambda one: one.last
) -> list[Regret]:
    """The ways that a case allows, the best first; those with fewer data sets than the others, too.

    Args:
        results: of a protocol.
        case: of it.
        at: what of a result counts, by default what the way gave in the end.
    """
    reference = reference_of(results, case)
    if reference is None:
        return []
    logs: dict[str, dict[int, float]] = {}
    found, by_way = [], _by_way(results, case)
    for way, some in by_way.items():
        scores = {one.set: at(one) for one in some}
        logs[way] = {
            place: math.log(one.score / reference.score) for place, one in scores.items() if one is not None
        }
        values = np.array(list(logs[way].values()))
        if not len(values):
            continue
        there = [one for one in scores.values() if one is not None]
        found.append(
            Regret(
                way,
                _exp(student(values)),
                math.exp(float(np.median(values))),
                math.exp(float(values.max())),
                float(np.median([one.nees for one in there])),
                float(np.median([one.nis for one in there])),
                reference.log_score - float(np.mean([one.log_score for one in there])),
                sum(bool(one.error) for one in some),
                len(values),
                float(np.median([one.taken_runs for one in some])),
                float(np.median([one.taken_seconds for one in some])),
            )
        )
    found.sort(key=lambda one: one.ratio.value)
    worse = holm([chance(logs[one.way], logs[found[0].way]) for one in found], LEVEL)
    return [one._replace(worse=is_worse) for one, is_worse in zip(found, worse, strict=True)]


def reference_of(results: Sequence[Result], case: Case) -> Scored | None:
    """What the best constant numbers of a case have, which cases that differ in their data share."""
    names = {one.case for one in results if one.way == REFERENCE}
    name = next((one for one in (case.name, case.name.split(",")[0]) if one in names), None)
    return next((one.last for one in results if one.way == REFERENCE and one.case == name), None)


def _by_way(results: Iterable[Result], case: Case) -> dict[str, list[Result]]:
    found: dict[str, list[Result]] = {}
    for one in results:
        if one.case == case.name and one.way != REFERENCE and one.last is not None:
            found.setdefault(one.way, []).append(one)
    return found


def student(values: np.ndarray) -> Interval:
    """The mean of some values with Student's 95 % interval; without ends for a single one."""
    from scipy.special import stdtrit

    mean = float(values.mean())
    if len(values) < 2:
        return Interval(mean, -math.inf, math.inf)
    half = float(stdtrit(len(values) - 1, 1.0 - LEVEL / 2.0)) * float(values.std(ddof=1)) / math.sqrt(len(values))
    return Interval(mean, mean - half, mean + half)


def chance(one: dict[int, float], best: dict[int, float]) -> float:
    """One-sided p-value of "no worse than the best", by Student's test of differences paired by data set."""
    from scipy.special import stdtr

    shared = [place for place in one if place in best]
    differences = np.array([one[place] - best[place] for place in shared])
    if len(differences) < 2 or not differences.any():
        return 1.0
    error = differences.std(ddof=1) / math.sqrt(len(differences))
    if error == 0.0:
        return 0.0 if differences[0] > 0 else 1.0
    return float(stdtr(len(differences) - 1, -differences.mean() / error))


def _exp(one: Interval) -> Interval:
    return Interval(*(math.exp(min(end, 700.0)) for end in one))
