"""The likeliest Q and R with a prior: maximum a posteriori with inverse Wishart distributions."""

from __future__ import annotations

import numpy as np

from thruster_env.model.state_space import StateSpaceModel
from tuning.likelihood.gradient import minimum_within
from tuning.search.objectives import LIKELIHOOD
from tuning.ways.task import Task

WEAK = 2  # degrees of freedom beyond the size of a covariance, so that the prior's mean is the start


def maximum_a_posteriori(task: Task) -> None:
    """L-BFGS-B on log L + log p(Q) + log p(R), from the task's start, which is the prior's mean.

        Q ~ IW(nu, Psi):  log p = -1/2 (nu + n + 1) log det Q - 1/2 tr(Psi Q^-1),   nu = n + 2,  Psi = Q_0

    of full matrices; else of each variance alone, with n = 1. It is the mode of the density of Q and R themselves.

    Source: Gelman, Carlin, Stern, Dunson, Vehtari, Rubin (2013), "Bayesian data analysis", 3rd ed., section 3.6.
    """
    goal = task.goal(LIKELIHOOD, keeps=False)
    coordinates, first = goal.coordinates, task.model(task.start)
    matrices = ("process_noise_cov", "full_q"), ("measurement_noise_cov", "full_r")
    best = -np.inf

    def negative(point: np.ndarray) -> tuple[float, np.ndarray]:
        nonlocal best
        found = goal(point)
        value, gradient = found.values.sum(), found.gradients.sum(axis=0)
        model, slopes = goal.model_at(point)
        for name, option in matrices:
            prior, by = _log_prior(first, model, getattr(slopes, name), name, bool(task.options.get(option)))
            value, gradient = value + prior, gradient + by
        if value > best:
            best = value
            task.keep(goal.choice_at(point))
        return -value, -gradient

    start = np.clip(coordinates.of(goal.untuned), coordinates.low, coordinates.high)
    task.keep(goal.choice_at(minimum_within(coordinates, negative, start).x))


def _log_prior(
    first: StateSpaceModel, model: StateSpaceModel, slopes: np.ndarray, name: str, full: bool
) -> tuple[float, np.ndarray]:
    """The logarithm of a covariance's prior, but for a constant, and its slopes along p coordinates, (p,)."""
    centre, cov = getattr(first, name), getattr(model, name)
    if not full:
        variances, before = np.diag(cov), np.diag(centre)
        there = variances > 0  # a state without noise has no prior
        v, c, by = variances[there], before[there], np.diagonal(slopes, axis1=1, axis2=2)[:, there]
        power = (1 + WEAK) + 1 + 1
        return float(-0.5 * (power * np.log(v) + c / v).sum()), by @ (-0.5 * (power / v - c / v**2))
    power = (len(cov) + WEAK) + len(cov) + 1
    whole = np.linalg.solve(cov, centre)
    value = -0.5 * power * np.linalg.slogdet(cov)[1] - 0.5 * np.trace(whole)
    relative = np.linalg.solve(cov, slopes)
    gradient = -0.5 * power * np.trace(relative, axis1=1, axis2=2)
    return float(value), gradient + 0.5 * np.einsum("pij,ji->p", relative, whole)
