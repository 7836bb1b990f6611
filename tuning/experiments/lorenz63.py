"""Lorenz's three equations, a standard problem of data assimilation, and the scores that others publish for it.

    x' = sigma (y - x),   y' = x (rho - z) - y,   z' = x y - beta z;   sigma = 10, rho = 28, beta = 8/3

Runge-Kutta steps of 0.01, an analysis every 25 of them, all three states observed with R = 2 I, no process noise.
Nothing has a unit: time is in that of the equations.

    thruster reproduce lorenz63
    thruster tune --problem tuning.experiments.lorenz63:problem --filter etkf --hold-r --trials 30
    thruster tune --problem tuning.experiments.lorenz63:problem --filter pf --hold-r --trials 30
    thruster tune --problem tuning.experiments.lorenz63:faded --filter ekf --trials 30
    thruster tune --problem tuning.experiments.lorenz63:jittered --filter pf --trials 30

The same measured half as often and four times as poorly, every 12 steps with R = 8 I, has beliefs that are not
Gaussian:

    thruster reproduce lorenz63-sparse
    thruster tune --problem tuning.experiments.lorenz63:sparse --filter rhf --hold-r --trials 30

Sources: E. N. Lorenz (1963), "Deterministic nonperiodic flow", J. Atmospheric Sciences 20, 130-141. The settings
are those of P. Sakov, D. S. Oliver, L. Bertino (2012), "An iterative EnKF for strongly nonlinear systems", Monthly
Weather Review 140, 1988-2004, Table 1; the scores those that the model file of DAPPER 1.7 quotes for them:
P. N. Raanes, Y. Chen, C. Grudzien (2024), "DAPPER: Data Assimilation with Python: a Package for Experimental
Research", J. Open Source Software 9(94), 5150. The sparse ones: J. L. Anderson (2010), "A non-Gaussian ensemble
filter update for data assimilation", Monthly Weather Review 138, 4186-4198, figure 10.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from filters import StateSpaceModel
from thruster_env.core.derivatives import complex_step, runge_kutta
from tuning.experiments.benchmark import Published, noise_free_problem, published_benchmark
from tuning.problems.model_problem import ModelProblem
from tuning.problems.problem import Parameter

SUBSTEP, SUBSTEPS = 0.01, 25  # an analysis every 0.25
STEPS, BURN_IN = 1000, 64  # analyses, and those that do not count: the first 16 units of time
START, START_VARIANCE = (1.509, -1.531, 25.46), 2.0
R = 2.0
SETTINGS: dict[str, Any] = {
    "steps": STEPS,
    "first_scored_step": BURN_IN + 1,
    "scale": [1.0] * 3,
    "dt": SUBSTEP * SUBSTEPS,
}
KERNEL = (4.0 / 5.0) ** (1.0 / 7.0)  # our kernel's width over the published one's N^(-1/7), for three states


class Constants(NamedTuple):
    """The equations' numbers, and by how much a filter's covariance grows of itself."""

    sigma: float
    rho: float
    beta: float
    substep: float
    growth: float  # factor on the deviations in one Runge-Kutta step; 1 is none


def rates(x, u, c):
    """(x', y', z')."""
    return (c.sigma * (x[1] - x[0]), x[0] * (c.rho - x[2]) - x[1], x[0] * x[1] - c.beta * x[2])


def observe(x, c):
    """All three."""
    return (x[0], x[1], x[2])


move = runge_kutta(rates, 3)
slopes = complex_step(move, 3, 3, "u, c")


def grown_slopes(x, u, c):
    """The Jacobian of one Runge-Kutta step, times the growth."""
    f, g = slopes(x, u, c), c.growth
    return (
        (g * f[0][0], g * f[0][1], g * f[0][2]),
        (g * f[1][0], g * f[1][1], g * f[1][2]),
        (g * f[2][0], g * f[2][1], g * f[2][2]),
    )


def model(inflation: float = 1.0, jitter: float = 0.0) -> StateSpaceModel:
    """The model with all that filters may believe beside the truth.

    Args:
        inflation: factor on the covariance of an extended filter in one unit of time; it is put into the Jacobian,
            P = (g F) P (g F)' with g^2 = inflation^0.01, for the filter itself has none.
        jitter: variance of a process noise that the truth does not have, for particle filters.
    """
    return StateSpaceModel(
        transition=move,
        transition_jacobian=grown_slopes,
        observe=observe,
        process_noise_cov=[jitter] * 3,
        measurement_noise_cov=[R] * 3,
        prior_mean=START,
        prior_cov=[START_VARIANCE] * 3,
        inputs=0,
        constants=Constants(10.0, 28.0, 8.0 / 3.0, SUBSTEP, float(np.sqrt(inflation**SUBSTEP))),
        substeps=SUBSTEPS,
        states=["x", "y", "z"],
    )


problem = noise_free_problem(model(), **SETTINGS)
faded = ModelProblem(model(), model, parameters=[Parameter("inflation", 1.0, 10_000.0)], **SETTINGS)
jittered = ModelProblem(model(), model, parameters=[Parameter("jitter", 1e-4, 10.0)], **SETTINGS)


def particles(size: int, width: float, threshold: float) -> dict[str, float]:
    """Numbers of a particle filter whose kernel has so many times the width N^(-1/7)."""
    return {"ensemble_size": size, "regularisation": width / KERNEL, "resampling_threshold": threshold}


PARTICLES = (
    Published("pf", particles(100, 2.4, 0.3), 0.38),
    Published("pf", particles(800, 0.9, 0.2), 0.28),
    Published("pf", particles(4000, 0.7, 0.05), 0.27),
)
BENCHMARK = published_benchmark("lorenz63", problem, model, *PARTICLES)


SPARSE_SUBSTEPS, SPARSE_BURN_IN = 12, 133  # an analysis every 0.12; again 16 units of time do not count


def sparse_model() -> StateSpaceModel:
    """The model, measured half as often and four times as poorly."""
    return model().replace(substeps=SPARSE_SUBSTEPS, measurement_noise_cov=[8.0] * 3)


SPARSE_SETTINGS = {"first_scored_step": SPARSE_BURN_IN + 1, "dt": SPARSE_SUBSTEPS * SUBSTEP}
sparse = noise_free_problem(sparse_model(), **SETTINGS | SPARSE_SETTINGS)
SPARSE = published_benchmark("lorenz63-sparse", sparse, sparse_model)
TABLES = {"lorenz63": BENCHMARK.markdown, "lorenz63_sparse": SPARSE.markdown}
