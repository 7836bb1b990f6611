"""Methods by gradients of an objective: L-BFGS-B in the coordinates of a study's numbers, from several starts."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import optuna
from optuna.distributions import BaseDistribution

from tuning.likelihood.gradient import optimum, start_at, starts_of
from tuning.methods.task import Task
from tuning.problems.parameter import Coordinates
from tuning.search.quiet import quiet_optuna
from tuning.search.samplers import make_sampler
from tuning.search.space import Choice


def ascend(objective: str) -> Callable[[Task], None]:
    """The method that follows the gradient of an objective from the task's start, then from those of `starts_of`.

    It is what `tune_by_gradient` does, which adds standard errors.
    """

    def run(task: Task) -> None:
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

    return run


# Searches of an objective without its gradient: the downhill simplex, and one number at a time.


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
        start = self.coordinates.of(task.values_of(task.start, task.searched))
        self.first = np.clip(start, self.coordinates.low, self.coordinates.high)
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
        for i in range(len(point)):
            for step in (FORWARD, BACKWARD):
                other = point + step * np.eye(len(point))[i]
                other = np.clip(other, descent.coordinates.low, descent.coordinates.high)
                value = descent(other)
                if value < least:
                    point, least = other, value
                    break
        if least == before:
            return


# Methods that ask one of Optuna's samplers for trials, and know of an objective nothing but its values.


MOST_TRIALS = 10_000
SLOWER = 10  # steps from one measurement to the next at the second sample time: 0.1 s and 1 s in the source


def sample(sampler: str, objective: str | None = None, slower: int | None = None) -> Callable[[Task], None]:
    """The method that minimises an objective, by default the task's, over trials of a sampler, from the start on.

    Every trial has the same runs, so that the differences between trials are not those of noise. With a second
    sample time, slower by so many steps, each trial is measured at both, and the larger value counts.
    """

    def run(task: Task) -> None:
        rates = [task.data] if slower is None else [task.data, [runs.every(slower) for runs in task.data]]
        space: dict[str, BaseDistribution] = {
            parameter.name: parameter.distribution for parameter in task.searched
        }
        with task.uncounted(), quiet_optuna():  # packages are loaded
            optuna_sampler = make_sampler(sampler, task.seed, 0, space)
            study = optuna.create_study(sampler=optuna_sampler)
        start = dict(zip(space, task.values_of(task.start, task.searched), strict=True))
        study.enqueue_trial(
            {
                parameter.name: min(max(start[parameter.name], parameter.low), parameter.high)
                for parameter in task.searched
            }
        )
        least = math.inf
        for _ in range(MOST_TRIALS):
            with quiet_optuna():
                trial = study.ask(space)
            choice = task.with_values([trial.params[name] for name in space], task.searched)
            value = max(task.value(choice, objective, data) for data in rates)
            study.tell(trial, value)
            if value < least:
                least = value
                task.keep(choice)

    return run
