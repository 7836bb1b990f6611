"""A model that is linear in three of its four states where the first is known.

    s' = arctan s + a + w_s,   (a, b, d)' = [[1, 0.3, 0], [0, 0.92, -0.3], [0, 0.3, 0.92]] (a, b, d) + w
    z = (0.1 s |s|, a - b + d) + v,   w ~ N(0, 0.01 I),  v ~ N(0, 0.1 I),  s_0 ~ N(0, 1),  (a, b, d)_0 = 0

    thruster tune --problem tuning.experiments.mixed_linear:problem --filter rbpf --trials 20

Source: the example of T. Schon, F. Gustafsson, P.-J. Nordlund (2005), "Marginalized particle filters for mixed
linear/nonlinear state-space models", IEEE Trans. Signal Processing 53(7), as LowLevelParticleFilters.jl has it.
"""

from __future__ import annotations

import numpy as np

from filters import StateSpaceModel
from tuning.problems.model_problem import ModelProblem

STEPS, FIRST_SCORED_STEP = 100, 5


def move(x, u, c):
    """One step."""
    s, a, b, d = x
    return (np.arctan(s) + a, a + 0.3 * b, 0.92 * b - 0.3 * d, 0.3 * b + 0.92 * d)


def see(x, c):
    """What s is, through a bent sensor that is blind at zero, and a sum of the others."""
    return (0.1 * x[0] * abs(x[0]), x[1] - x[2] + x[3])


def model(measurement_variance: float = 0.1) -> StateSpaceModel:
    """The model, with the variance of both sensors; s is state 0."""
    return StateSpaceModel(
        transition=move,
        observe=see,
        process_noise_cov=[0.01] * 4,
        measurement_noise_cov=[measurement_variance] * 2,
        prior_mean=[0.0] * 4,
        prior_cov=[1.0, 0.0, 0.0, 0.0],
        inputs=0,
        states=[(name, name, "") for name in "sabd"],
        measurements=[("of s", "y", ""), ("of the others", "z", "")],
    )


def problem_of(assumed: StateSpaceModel) -> ModelProblem:
    """A problem whose truth is the model; errors are measured in about those of a good filter."""
    scale = [0.46, 0.28, 0.21, 0.18]
    return ModelProblem(assumed, steps=STEPS, first_scored_step=FIRST_SCORED_STEP, scale=scale, dt=1.0)


problem = problem_of(model())
