"""Estimates within bounds on the states, by truncated moments or by projection, for any filter of one Gaussian.

The filter itself continues with the unconstrained belief x, P; only the estimates that it returns are constrained:

- truncation: the moments of the normal distribution within the bounds. If the truncated state i, with s^2 = P_ii,
  has the mean mu and the variance v in units of s: x += P_i mu/s, P += P_i P_i' (v - 1)/s^2. For several bounded
  states this is repeated until it converges, each time for one state without its own bound and with all other
  bounds (expectation propagation).
- projection: the x within the bounds with the smallest (x - x_f)' P^-1 (x - x_f), where x_f is the filter's mean;
  P is unchanged.

If the filter continued with the constrained belief, a bound would count again in each step: the estimate of a
constant would drift away from it.

Source: Simon, Simon (2010), "Constrained Kalman filtering via density function truncation for turbofan engine
health estimation"; Simon (2010), "Kalman filtering with state constraints: a survey"; for several states
Cunningham, Hennig, Lacoste-Julien (2011), "Gaussian probabilities and expectation propagation"; for the quadratic
programme Hildreth (1957), "A quadratic programming procedure".
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np

from filters.engine.belief import Kernels, memory_places
from thruster_env.core.compiled import CompiledOrPython, function_fingerprint, inlined, is_interpreting
from thruster_env.core.streams import truncated_normal
from thruster_env.model.state_bounds import Bound

TRUNCATION, PROJECTION = "truncation", "projection"
ROUNDS = 10_000  # at most, over all bounds
ENOUGH, SETTLED = 1e-14, 1e-10  # last changes of projection and of truncation, in standard deviations
LEAST = 1e-12  # fraction of a variance that truncation leaves at least


@lru_cache(maxsize=64)
def bounded_kernels(kernels: Kernels, bounds: tuple[Bound, ...], bounded_by: str) -> Kernels:
    """Kernels of the same filter with mean and covariance within bounds.

    Its unconstrained mean (n,) and covariance (n, n) are the last of `Belief.extras`.
    """
    n, layout = kernels.n, memory_places(kernels.n, kernels.m)
    mean, free = layout.mean, layout.extras + kernels.extras + kernels.scratch
    size = n + n * n  # mean and covariance are neighbours
    plain_start, plain_predict, plain_update = kernels.start, kernels.predict, kernels.update
    constrain = _constraint(n, mean, layout.cov, bounds, bounded_by)

    @inlined
    def tell(row):
        for i in range(size):
            row[free + i] = row[mean + i]
        constrain(row)

    @inlined
    def recall(row):
        for i in range(size):
            row[mean + i] = row[free + i]

    @inlined
    def start(memory, numbers, size):
        plain_start(memory, numbers, size)
        tell(memory[0])

    @inlined
    def predict(memory, u, numbers, size):
        recall(memory[0])
        plain_predict(memory, u, numbers, size)
        tell(memory[0])

    @inlined
    def update(memory, z, numbers, size):
        recall(memory[0])
        plain_update(memory, z, numbers, size)
        tell(memory[0])

    extras = kernels.extras + kernels.scratch + size
    return kernels._replace(start=start, predict=predict, update=update, extras=extras, scratch=0, vectors=())


def constrained(
    means: np.ndarray, covs: np.ndarray, bounds: tuple[Bound, ...], bounded_by: str
) -> tuple[np.ndarray, np.ndarray]:
    """Means (..., n) and covariances (..., n, n) within bounds, from those of unconstrained Gaussians."""
    n = means.shape[-1]
    rows = np.concatenate([means.reshape(-1, n), covs.reshape(-1, n * n)], axis=1)
    _constrain_rows(n, bounds, bounded_by, is_interpreting())(rows)
    return rows[:, :n].reshape(means.shape), rows[:, n:].reshape(covs.shape)


@lru_cache(maxsize=64)
def _constrain_rows(n: int, bounds: tuple[Bound, ...], bounded_by: str, interpreting: bool) -> CompiledOrPython:
    constrain = _constraint(n, 0, n, bounds, bounded_by)
    fingerprint = function_fingerprint(constrain, within=__name__)

    def constrain_rows(rows):
        fingerprint  # noqa: B018 - part of the cache's key
        for i in range(len(rows)):
            constrain(rows[i])

    return CompiledOrPython(constrain_rows)


def _constraint(n: int, mean: int, cov: int, bounds: tuple[Bound, ...], bounded_by: str) -> Callable:
    """The function that constrains the mean and the covariance at these offsets of a row."""
    states, low, high = (tuple(getattr(bound, name) for bound in bounds) for name in ("place", "low", "high"))
    return (_truncation if bounded_by == TRUNCATION else _projection)(n, mean, cov, states, low, high)


def _truncation(n: int, mean: int, cov: int, states: tuple, low: tuple, high: tuple) -> Callable:
    @inlined
    def constrain(row):
        # A state's bounds act as a Gaussian factor: a precision and an information. The cavity is without it.
        column, precisions, informations = np.zeros(n), np.zeros(len(states)), np.zeros(len(states))
        for _ in range(ROUNDS if len(states) > 1 else 1):
            largest = 0.0
            for b in range(len(states)):
                i = states[b]
                x, p = row[mean + i], row[cov + i * n + i]
                precision = 1.0 / p - precisions[b] if p > 0.0 else 0.0
                if precision > 0.0:
                    s, cavity = precision**-0.5, (x / p - informations[b]) / precision
                    shift, variance = truncated_normal((low[b] - cavity) / s, (high[b] - cavity) / s)
                    new_x, new_p = cavity + s * shift, max(s * s * variance, LEAST * p)
                    for j in range(n):
                        column[j] = row[cov + j * n + i] / p
                    for j in range(n):
                        row[mean + j] += column[j] * (new_x - x)
                        for k in range(n):
                            row[cov + j * n + k] += column[j] * column[k] * (new_p - p)
                    row[mean + i], row[cov + i * n + i] = min(max(new_x, low[b]), high[b]), new_p
                    precisions[b], informations[b] = 1.0 / new_p - precision, new_x / new_p - cavity * precision
                    largest = max(largest, abs(new_x - x) / p**0.5, abs(new_p / p - 1.0))
            if not largest > SETTLED:
                break
        for b in range(len(states)):
            row[mean + states[b]] = min(max(row[mean + states[b]], low[b]), high[b])

    return constrain


def _projection(n: int, mean: int, cov: int, states: tuple, low: tuple, high: tuple) -> Callable:
    @inlined
    def constrain(row):
        forces = np.zeros(len(states))  # x = x_f + P (the forces at the bounds), each zero or at its bound
        for _ in range(ROUNDS):
            largest = 0.0
            for b in range(len(states)):
                i = states[b]
                p = row[cov + i * n + i]
                if p > 0.0:
                    without = row[mean + i] - p * forces[b]
                    force = (min(max(without, low[b]), high[b]) - without) / p
                    change = force - forces[b]
                    for j in range(n):
                        row[mean + j] += row[cov + j * n + i] * change
                    forces[b] = force
                    largest = max(largest, abs(change) * np.sqrt(p))
            if not largest > ENOUGH:
                break
        for b in range(len(states)):
            row[mean + states[b]] = min(max(row[mean + states[b]], low[b]), high[b])

    return constrain
