"""Ways by gradients of an objective: L-BFGS-B in the coordinates of a study's numbers, from several starts."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tuning.likelihood.gradient import optimum, start_at, starts_of
from tuning.ways.task import Task


def ascend(objective: str) -> Callable[[Task], None]:
    """The way that follows the gradient of an objective: from the task's start, then from those of `starts_of`.

    It is what `tune_by_gradient` does, which adds standard errors.
    """

    def follow(task: Task) -> None:
        goal = task.goal(objective)
        coordinates = goal.coordinates
        first = np.clip(coordinates.of(goal.untuned), coordinates.low, coordinates.high)
        best = optimum(goal, first)
        task.keep(goal.choice_at(coordinates.of(best.parameters)))
        for factors in starts_of(coordinates.free)[1:]:
            other = optimum(goal, np.clip(start_at(goal, factors), coordinates.low, coordinates.high))
            if other.value > best.value:
                best = other
            task.keep(goal.choice_at(coordinates.of(best.parameters)))

    return follow
