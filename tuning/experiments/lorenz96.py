"""Lorenz's ring of forty states, a standard problem of data assimilation, and the scores that others publish.

    x_i' = (x_{i+1} - x_{i-2}) x_{i-1} - x_i + F,   i = 1 ... 40 around a ring, F = 8

One Runge-Kutta step of 0.05 and an analysis of all forty states, R = I, no process noise. Nothing has a unit: time
is in that of the equations.

    thruster reproduce lorenz96
    thruster tune --problem tuning.experiments.lorenz96:problem --filter etkf --hold-r --trials 30

Sources: E. N. Lorenz, K. A. Emanuel (1998), "Optimal sites for supplementary weather observations: simulation with
a small model", J. Atmospheric Sciences 55, 399-414. The settings are those of P. Sakov, P. R. Oke (2008), "A
deterministic formulation of the ensemble Kalman filter", Tellus 60A, 361-371, Table 1; the scores those that the
model file of DAPPER 1.7 quotes for 1000 analyses; see `tuning.experiments.lorenz63`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from filters import StateSpaceModel
from thruster_env.model.quantities import Positions
from tuning.experiments.benchmark import noise_free_problem, published_benchmark

STATES, FORCING, SUBSTEP = 40, 8.0, 0.05
STEPS, BURN_IN = 1000, 400  # analyses, and those that do not count: the first 20 units of time
START_VARIANCE, R = 0.001, 1.0


class Constants(NamedTuple):
    """The equations' numbers, and by how much a filter's covariance grows of itself."""

    forcing: float
    substep: float
    growth: float  # factor on the deviations in one step; 1 is none


def rates(x, forcing):
    """x', (n,)."""
    n = x.shape[0]
    out = np.empty(n)
    out[0] = (x[1] - x[n - 2]) * x[n - 1] - x[0] + forcing
    out[1] = (x[2] - x[n - 1]) * x[0] - x[1] + forcing
    for i in range(2, n - 1):
        out[i] = (x[i + 1] - x[i - 2]) * x[i - 1] - x[i] + forcing
    out[n - 1] = (x[0] - x[n - 3]) * x[n - 2] - x[n - 1] + forcing
    return out


def slopes_times(x, d):
    """The Jacobian of the rates at x times a matrix d (n, n)."""
    n = x.shape[0]
    out = np.empty((n, n))
    for i in range(n):
        after, before, second = (i + 1) % n, (i - 1) % n, (i - 2) % n
        difference = x[after] - x[second]
        for j in range(n):
            out[i, j] = x[before] * (d[after, j] - d[second, j]) + difference * d[before, j] - d[i, j]
    return out


def move(x, u, c):
    """One Runge-Kutta step, (n,)."""
    h = c.substep
    k1 = rates(x, c.forcing)
    k2 = rates(x + 0.5 * h * k1, c.forcing)
    k3 = rates(x + 0.5 * h * k2, c.forcing)
    k4 = rates(x + h * k3, c.forcing)
    return x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)


def grown_slopes(x, u, c):
    """The Jacobian of that step, times the growth, (n, n)."""
    h, eye = c.substep, np.eye(x.shape[0])
    k1 = rates(x, c.forcing)
    k2 = rates(x + 0.5 * h * k1, c.forcing)
    k3 = rates(x + 0.5 * h * k2, c.forcing)
    d1 = slopes_times(x, eye)
    d2 = slopes_times(x + 0.5 * h * k1, eye + 0.5 * h * d1)
    d3 = slopes_times(x + 0.5 * h * k2, eye + 0.5 * h * d2)
    d4 = slopes_times(x + h * k3, eye + h * d3)
    return c.growth * (eye + h / 6.0 * (d1 + 2.0 * d2 + 2.0 * d3 + d4))


def observe(x, c):
    """All states."""
    return x


def model(inflation: float = 1.0) -> StateSpaceModel:
    """The model with all that filters may believe beside the truth.

    Args:
        inflation: factor on the covariance of an extended filter in one unit of time; it is put into the Jacobian,
            P = (g F) P (g F)' with g^2 = inflation^0.05, for the filter itself has none.
    """
    return StateSpaceModel(
        transition=move,
        transition_jacobian=grown_slopes,
        observe=observe,
        process_noise_cov=np.zeros(STATES),
        measurement_noise_cov=np.full(STATES, R),
        prior_mean=np.eye(STATES)[0],
        prior_cov=np.full(STATES, START_VARIANCE),
        inputs=0,
        constants=Constants(FORCING, SUBSTEP, float(np.sqrt(inflation**SUBSTEP))),
        positions=Positions(range(STATES), range(STATES), STATES),
    )


problem = noise_free_problem(
    model(), steps=STEPS, first_scored_step=BURN_IN + 1, scale=np.ones(STATES), dt=SUBSTEP, about="Lorenz-96"
)

BENCHMARK = published_benchmark("lorenz96", problem, model)
TABLES = {"lorenz96": BENCHMARK.markdown}
