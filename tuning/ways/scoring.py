"""Fisher scoring: Newton's method with the expected information in place of the Hessian."""

from __future__ import annotations

import numpy as np

from tuning.evaluation.baselines import with_covariances
from tuning.evaluation.residuals import estimated_from
from tuning.search.objectives import LIKELIHOOD
from tuning.ways.task import Task

MOST_STEPS = 100
CLOSE = 1e-8  # of the log-likelihood that a step is expected to gain, which ends it
DAMPING, LEAST, MOST = 1e-3, 1e-9, 1e9  # parts of the diagonal that are added to the information


def scoring(task: Task) -> None:
    """Maximum likelihood by damped Fisher scoring, within the ranges.

        (I + d diag I) step = g,   I = E[g g'],   d a tenth after a step that gains, else ten times as large

    Numbers at an end of their range, which the gradient would drive beyond it, stay there.

    Source: Gupta, Mehra (1974), "Computational aspects of maximum likelihood estimation and reduction in
    sensitivity function calculations", IEEE Transactions on Automatic Control 19(6); damped: Marquardt (1963).
    """
    goal = task.goal(LIKELIHOOD)
    low, high = goal.coordinates.low, goal.coordinates.high
    point, damping = np.clip(goal.coordinates.of(goal.untuned), low, high), DAMPING
    some = goal.of_few(32)
    price = task.price("information", lambda: some.information(point))
    value, gradient = _of(goal(point))
    for _ in range(MOST_STEPS):
        information = goal.information(point)
        task.charge(price * task.passes)
        inside = ~(((point <= low) & (gradient < 0)) | ((point >= high) & (gradient > 0)))
        part, slope = information[np.ix_(inside, inside)], gradient[inside]
        while damping < MOST and inside.any():
            step = np.zeros_like(point)
            damped = part + damping * np.diag(np.maximum(np.diag(part), 1e-12))
            step[inside] = np.linalg.solve(damped, slope)
            there = np.clip(point + step, low, high)
            if gradient @ (there - point) < CLOSE:
                return
            after, slopes = _of(goal(there))
            if np.isfinite(after) and after > value and np.isfinite(slopes).all():
                point, value, gradient, damping = there, after, slopes, max(0.1 * damping, LEAST)
                break
            damping *= 10.0
        else:
            return


def _of(found) -> tuple[float, np.ndarray]:
    return float(found.values.sum()), found.gradients.sum(axis=0)


# Noise estimation from true states: the only way without a search, and the best one for a model that is right.


def noise_estimation(task: Task) -> None:
    """Q = cov(x' - f(x, u)), R = cov(z - h(x)), full matrices; of several problems their means by runs.

    Source: Abbeel, Coates, Montemerlo, Ng, Thrun (2005), "Discriminative training of Kalman filters", Robotics:
    Science and Systems, where it is the likelihood of states and measurements together.
    """
    found = []
    for problem, data in zip(task.problems, task.data, strict=True):
        one = estimated_from(problem.model(**problem.untuned), data)
        if one.process_cov is None or one.measurement_cov is None:
            raise ValueError(f"way 'noise-estimation' needs residuals on {problem.name}, but {one.reason}")
        found.append((one.process_cov, one.measurement_cov))
    task.charge(task.passes)
    weights = [len(one.seeds) for one in task.data]
    q, r = (np.average(np.array(some), axis=0, weights=weights) for some in zip(*found, strict=True))
    task.keep(with_covariances(task.start, q, None if task.options.get("hold_r") else r))
