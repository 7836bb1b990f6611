"""Q and R by Fisher scoring, Newton's method with the expected information as Hessian, and by noise estimation."""

from __future__ import annotations

import numpy as np

from tuning.evaluation.baselines import with_covariances
from tuning.evaluation.residuals import estimated_from
from tuning.methods.task import Task
from tuning.search.objectives import LIKELIHOOD

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
    few = goal.of_few(32)
    price = task.price("information", lambda: few.information(point))
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
            trial = np.clip(point + step, low, high)
            if gradient @ (trial - point) < CLOSE:
                return
            after, slopes = _of(goal(trial))
            if np.isfinite(after) and after > value and np.isfinite(slopes).all():
                point, value, gradient, damping = trial, after, slopes, max(0.1 * damping, LEAST)
                break
            damping *= 10.0
        else:
            return


def _of(likelihood) -> tuple[float, np.ndarray]:
    return float(likelihood.values.sum()), likelihood.gradients.sum(axis=0)


def noise_estimation(task: Task) -> None:
    """Q = cov(x' - f(x, u)), R = cov(z - h(x)), full matrices; of several problems their means by runs.

    It is the only method without a search, and the best one if the model is right.

    Source: Abbeel, Coates, Montemerlo, Ng, Thrun (2005), "Discriminative training of Kalman filters", Robotics:
    Science and Systems, where it is the likelihood of states and measurements together.
    """
    estimates = []
    for problem, data in zip(task.problems, task.data, strict=True):
        estimate = estimated_from(problem.model(**problem.untuned), data)
        if estimate.process_cov is None or estimate.measurement_cov is None:
            raise ValueError(f"method 'noise-estimation' needs residuals on {problem.name}, but {estimate.reason}")
        estimates.append((estimate.process_cov, estimate.measurement_cov))
    task.charge(task.passes)
    weights = [len(runs.seeds) for runs in task.data]
    q, r = (np.average(np.array(covs), axis=0, weights=weights) for covs in zip(*estimates, strict=True))
    task.keep(with_covariances(task.start, q, None if task.options.get("hold_r") else r))
