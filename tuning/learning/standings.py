"""Trained estimators and filters on runs that no training saw, also on longer and noisier ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from typing import NamedTuple

import numpy as np

from filters.consistency.intervals import Interval
from filters.filter import Filter
from tuning.evaluation.evaluate import NOTHING, Evaluation, evaluate, score_ratio
from tuning.problems.check import data_of
from tuning.problems.data import Data
from tuning.problems.env_problem import measurement_noise
from tuning.problems.model_problem import ModelProblem
from tuning.problems.problem import Problem
from tuning.problems.scenario import BaseScenario

# Held-out runs that differ from those of a training: twice as long, and with a larger measurement noise.


LARGER = 4.0  # factor on R


def twice_as_long(problem: Problem, seeds: Sequence[int]) -> Data | None:
    """Runs of a problem that are twice as long; None of one whose runs have their length."""
    if isinstance(problem, BaseScenario):
        return problem.replace(steps=2 * problem.steps).data(seeds)
    if isinstance(problem, ModelProblem) and not isinstance(problem.inputs, np.ndarray):
        longer = copy(problem)
        longer.steps = 2 * problem.steps
        return longer.make(tuple(seeds))
    return None


def with_larger_noise(problem: Problem, data: Data, factor: float = LARGER) -> Data:
    """Runs whose measurements have a further noise, of covariance (factor - 1) R, so that theirs is factor R.

    R is the plant's, or where that is unknown the data sheet's. Random numbers follow from the runs' keys.
    """
    model = problem.model(**(problem.untuned if problem.true is None else problem.true))
    steps, keys = np.arange(data.measurements.shape[1]), data.filter_keys.astype(np.int64)
    noise = measurement_noise(keys, steps, (factor - 1.0) * model.measurement_noise_cov)
    return data._replace(measurements=data.measurements + noise)


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
    results = []
    for label, filter_ in filters.items():
        evaluations = {
            name: evaluate(filter_, data_, problem.scale) for name, data_ in runs.items() if data_ is not None
        }
        results.append(Standing(label, filter_.name, evaluations))
    return results
