"""Ways down an objective without its gradient: the downhill simplex, and one number at a time."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from tuning.problems.coordinates import Coordinates
from tuning.search.space import Choice
from tuning.ways.task import Task

FORWARD, BACKWARD = math.log(1.1), math.log(0.5)  # steps in coordinates
ITERATIONS, LIMIT = 20, 0.1  # MATLAB's defaults: passes over all numbers, and the RMS error that is small enough
SIDE = math.log(10.0)  # of the first simplex, in coordinates
FEW = 4  # numbers, up to which the simplex has its first coefficients
CLOSE = 1e-3  # size of a simplex, in coordinates, and relative spread of its values, at which it ends


class Descent:
    """An objective over the coordinates of what is searched, whose least value is kept."""

    def __init__(self, task: Task, evaluate: Callable[[Choice], float]):
        """Begin at the task's start."""
        self.task, self.coordinates, self._evaluate = task, Coordinates(task.searched), evaluate
        given = self.coordinates.of(task.values_of(task.start, task.searched))
        self.first = np.clip(given, self.coordinates.low, self.coordinates.high)
        self.least = math.inf

    def __call__(self, point: np.ndarray) -> float:
        """The value at coordinates, which are put within the box."""
        point = np.clip(point, self.coordinates.low, self.coordinates.high)
        choice = self.task.with_values(self.coordinates.values(point), self.task.searched)
        value = self._evaluate(choice)
        if value < self.least:
            self.least = value
            self.task.keep(choice)
        return value


def nelder_mead(task: Task, evaluate: Callable[[Choice], float] | None = None) -> None:
    """The downhill simplex in coordinates, begun once more at its end; of many numbers with adapted coefficients.

    Sources: Nelder, Mead (1965), "A simplex method for function minimization", Computer J. 7(4); Gao, Han (2012),
    "Implementing the Nelder-Mead simplex algorithm with adaptive parameters", Comput. Optim. Appl. 51; for a
    filter T. D. Powell (2002), "Automated tuning of an extended Kalman filter using the downhill simplex
    algorithm", J. Guidance, Control, Dynamics 25(5).
    """
    from scipy.optimize import minimize

    descent = Descent(task, evaluate or task.value)
    point, p = descent.first, len(descent.first)
    for _ in range(2):
        corners = np.vstack([point, point + SIDE * np.eye(p)])
        over = corners > descent.coordinates.high
        corners = np.where(over, 2.0 * point - corners, corners)
        options = {"initial_simplex": corners, "adaptive": p > FEW, "xatol": CLOSE, "fatol": CLOSE * CLOSE}
        options |= {"maxiter": 200 * p, "maxfev": 400 * p}
        point = np.clip(
            minimize(descent, point, method="Nelder-Mead", options=options).x,
            descent.coordinates.low,
            descent.coordinates.high,
        )


def coordinate_steps(task: Task) -> None:
    """Each number in turn times 1.1, or else times 0.5, wherever the objective falls; twenty times over all.

    Of numbers on linear scales the steps are as long in coordinates. It ends where no step helps.

    Source: the documented defaults of `tune` and `tunerconfig` of MATLAB's Sensor Fusion and Tracking Toolbox
    (StepForward 1.1, StepBackward 0.5, MaxIterations 20); their order is our reading of them.
    """
    descent = Descent(task, task.value)
    point = descent.first
    least = descent(point)
    for _ in range(ITERATIONS):
        before = least
        for place in range(len(point)):
            for step in (FORWARD, BACKWARD):
                other = point + step * np.eye(len(point))[place]
                other = np.clip(other, descent.coordinates.low, descent.coordinates.high)
                value = descent(other)
                if value < least:
                    point, least = other, value
                    break
        if least == before:
            return
