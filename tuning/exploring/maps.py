"""A map: score and NIS of a filter over two of its numbers."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from filters.filter import Filter
from tuning.evaluation.evaluate import values_of
from tuning.exploring.knobs import Knob
from tuning.problems.data import Data
from tuning.search.objectives import LIKELIHOOD, SCORE, find_objective, nis_ratio


class Map(NamedTuple):
    """Score and NIS at each pair of values of two knobs."""

    x: str  # name of the knob
    y: str
    xs: np.ndarray  # (size,), of a whole number its different values, which may be fewer
    ys: np.ndarray  # (size,)
    score: np.ndarray  # (y, x); negative log-likelihood of a run where there is no truth
    nis: np.ndarray  # (y, x), the mean NIS over its expected value: 1 is right; NaN without a covariance


def values_along(knob: Knob, size: int) -> np.ndarray:
    """Values over the range of a knob, on its scale."""
    found = (np.geomspace if knob.log else np.linspace)(knob.low, knob.high, size)
    return np.unique(np.rint(found)) if knob.integer else np.clip(found, knob.low, knob.high)


def map_of(x: Knob, y: Knob, size: int, case: Callable[[float, float], tuple[Filter, Data]], scale) -> Map:
    """Run a filter at each point of the map.

    Args:
        x: the knob along the rows.
        y: the other one.
        size: number of values of each.
        case: the filter at a value of each, and its data.
        scale: of the score, (n,); None without truth.
    """
    xs, ys = values_along(x, size), values_along(y, size)
    found = np.empty((2, len(ys), len(xs)))
    objective = find_objective(LIKELIHOOD if scale is None else SCORE)

    for row, column in np.ndindex(len(ys), len(xs)):
        evaluation = values_of(*case(xs[column].item(), ys[row].item()), scale)
        found[:, row, column] = objective.value(evaluation, np.nan), nis_ratio(evaluation)
    return Map(x.name, y.name, xs, ys, *found)
