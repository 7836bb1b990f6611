"""Trained estimators and filters on runs that no training saw, also on longer and noisier ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from filters.consistency.intervals import Interval
from filters.filter import Filter
from tuning.evaluation.evaluate import NOTHING, Evaluation, evaluate, score_ratio
from tuning.learning.variants import LARGER, twice_as_long, with_larger_noise
from tuning.problems.check import data_of
from tuning.problems.problem import Problem

HELD_OUT, LONGER, NOISIER = "held out", "twice as long", f"R x {LARGER:g}"


class Standing(NamedTuple):
    """A filter or an estimator on held-out runs, and on runs that differ from those of the training.

    Attributes:
        label: for tables.
        name: of the filter.
        evaluations: by "held out", "twice as long" and "R x 4"; the second is missing if there are none.
    """

    label: str
    name: str
    evaluations: Mapping[str, Evaluation]

    def ratio(self, first: Standing, runs: str = HELD_OUT) -> Interval:
        """Score over that of another one, paired on the same runs; NaN where there are none."""
        if runs not in self.evaluations:
            return NOTHING
        return score_ratio(self.evaluations[runs], first.evaluations[runs])


def standings(filters: Mapping[str, Filter], problem: Problem, seeds: Sequence[int]) -> list[Standing]:
    """Filters by label on held-out seeds of a problem, and on the same with longer runs and larger noise."""
    data = data_of(problem, seeds)
    runs = {HELD_OUT: data, LONGER: twice_as_long(problem, seeds), NOISIER: with_larger_noise(problem, data)}
    found = []
    for label, filter_ in filters.items():
        some = {name: evaluate(filter_, one, problem.scale) for name, one in runs.items() if one is not None}
        found.append(Standing(label, filter_.name, some))
    return found
