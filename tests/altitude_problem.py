"""Altitude from a barometer and a range finder, the accelerometer an input with a drifting bias: four own numbers.

Q is singular, for the accelerometer's noise moves height and speed together.
"""

import numpy as np

from filters import StateSpaceModel
from tuning.problems.model_problem import ModelProblem
from tuning.problems.problem import Parameter

DT = 0.05
TRUE = {"sigma_a": 0.3, "sigma_b": 1e-3, "r_baro": 0.25, "r_range": 4e-4}
GIVEN = {"sigma_a": 1.0, "sigma_b": 1e-2, "r_baro": 0.2, "r_range": 3e-4}
STATES = [("height", "z", "m"), ("climb rate", "v", "m/s"), ("bias of the accelerometer", "b", "m/s^2")]


def climb(x, u, c):
    """Dead reckoning by the accelerometer less its bias."""
    a = u[0] - x[2]
    return (x[0] + DT * x[1] + 0.5 * DT * DT * a, x[1] + DT * a, x[2])


def look(x, c):
    """Both sensors measure the height."""
    return (x[0], x[0])


def model(
    sigma_a=GIVEN["sigma_a"], sigma_b=GIVEN["sigma_b"], r_baro=GIVEN["r_baro"], r_range=GIVEN["r_range"]
) -> StateSpaceModel:
    """The model with standard deviations in m/s^2 and variances in m^2, as the user wrote it."""
    g = np.array([0.5 * DT * DT, DT, 0.0])
    return StateSpaceModel(
        transition=climb,
        observe=look,
        process_noise_cov=sigma_a**2 * np.outer(g, g) + np.diag([0.0, 0.0, DT * sigma_b**2]),
        measurement_noise_cov=[r_baro, r_range],
        prior_mean=[0.0, 0.0, 0.0],
        prior_cov=[1.0, 0.1, 0.04],
        inputs=1,
        states=STATES,
        input_quantities=[("measured acceleration", "a", "m/s^2")],
        measurements=[("barometer", "z_b", "m"), ("range finder", "z_r", "m")],
    )


def inputs(seeds, steps):
    """Accelerations that go up and down, another period each seed."""
    time = DT * np.arange(steps)
    return np.stack([[[np.sin(time_ * (0.5 + 0.1 * (seed % 7)))] for time_ in time] for seed in seeds])


def problem(**changes):
    """The altitude problem: the truth has other numbers than the user's model."""
    names = {"sigma_a": (1e-3, 1e2), "sigma_b": (1e-6, 1e1), "r_baro": (1e-4, 1e4), "r_range": (1e-6, 1e4)}
    parameters = [Parameter(name, *ends) for name, ends in names.items()]
    given = {"inputs": inputs, "steps": 300, "parameters": parameters, "dt": DT, "name": "altitude"}
    return ModelProblem(model(**TRUE), **{"assumed": model, **given, **changes})
