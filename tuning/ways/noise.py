"""Noise estimation from true states: the only way without a search, and the best one for a model that is right."""

from __future__ import annotations

import numpy as np

from tuning.evaluation.baselines import with_covariances
from tuning.evaluation.residuals import estimated_from
from tuning.ways.task import Task


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
