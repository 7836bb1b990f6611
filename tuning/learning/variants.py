"""Held-out runs that differ from those of a training: twice as long, and with a larger measurement noise."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy

import numpy as np

from tuning.problems.data import Data
from tuning.problems.episodes import measurement_noise
from tuning.problems.model_problem import ModelProblem
from tuning.problems.problem import Problem
from tuning.problems.scenario import BaseScenario

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
