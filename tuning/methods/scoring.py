"""Q and R by Fisher scoring, Newton's method with the expected information as Hessian, and by noise estimation."""

from __future__ import annotations

import numpy as np

from tuning.evaluation.baselines import with_covariances
from tuning.evaluation.residuals import estimated_from
from tuning.likelihood.ascent import climb
from tuning.methods.task import Task
from tuning.search.objectives import LIKELIHOOD

MOST_STEPS = 100
CLOSE = 1e-8  # of the log-likelihood that a step is expected to gain, which ends it


def scoring(task: Task) -> None:
    """Maximum likelihood by damped Fisher scoring, within the ranges (`tuning.likelihood.ascent.climb`).

    Source: Gupta, Mehra (1974), "Computational aspects of maximum likelihood estimation and reduction in
    sensitivity function calculations", IEEE Transactions on Automatic Control 19(6); damped: Marquardt (1963).
    """
    goal = task.goal(LIKELIHOOD, information=True)
    climb(goal, goal.start, iterations=MOST_STEPS, enough=CLOSE)


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
