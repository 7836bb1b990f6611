"""Measurements that are left out and have to be predicted: an error that needs no truth."""

from __future__ import annotations

import math

import numpy as np

from thruster_env.core.angles import difference
from tuning.evaluation.residuals import predicted
from tuning.problems.in_parts import estimates_in_parts
from tuning.search.space import Choice
from tuning.ways.descents import nelder_mead
from tuning.ways.task import Task

PART = 0.5  # of the times, at which all channels are left out


def masked(task: Task) -> None:
    """Nelder and Mead's simplex on the error of predicted measurements, half of which the filter does not see.

        J = sum over channels of mean (z - h(x^))^2 / var(z - h(x^)) of the start,  at the times left out

    It determines Q against R and no common factor on both, as every error does.

    Source: Barratt, Boyd (2020), "Fitting a Kalman smoother to data", American Control Conference, where a
    smoother takes the place of the filter.
    """
    hidden = [task.generator.random(one.measurements.shape[:2]) < PART for one in task.data]
    scales: list[np.ndarray] = []

    def error(choice: Choice) -> float:
        squares = np.mean([_squares(task, choice, place, one) for place, one in enumerate(hidden)], axis=0)
        task.charge(task.passes)
        if not scales:
            scales.append(np.where(squares > 0, squares, 1.0))
        value = float((squares / scales[0]).sum())
        return value if math.isfinite(value) else math.inf

    with task.uncounted():
        _squares(task, task.start, 0, hidden[0])
    nelder_mead(task, error)


def _squares(task: Task, choice: Choice, place: int, hidden: np.ndarray) -> np.ndarray:
    """Mean squares (m,) of predicted measurements at scored times that are hidden."""
    problem, data = task.problems[place], task.data[place]
    filter_, model = choice.filter(problem), task.model(choice, place)
    blind = data._replace(measurements=np.where(hidden[..., None], np.nan, data.measurements))
    totals, counts, first = 0.0, 0, 0
    for some, found in estimates_in_parts(filter_, blind):
        last = first + len(some.seeds)
        _, expected = predicted(model, found.means, some.seen.inputs)
        z = some.late_scored(data.measurements[first:last])
        left = difference(z, expected[:, data.late], model.shape.measurement_angles)
        left = np.where(hidden[first:last, data.late, None], left, np.nan)
        totals = totals + np.nansum(left**2, axis=(0, 1))
        counts = counts + (~np.isnan(left)).sum(axis=(0, 1))
        first = last
    return totals / np.maximum(counts, 1)
