"""Gymnasium's Pendulum-v1 with an encoder on its axis: a physical constant is tuned beside the noise.

    omega' = 3/2 g sin(theta) + 3 u,   theta' = omega   (a rod of 1 m and 1 kg, theta from upright)

What I had: 9.81 m/s^2 for gravity, where the env takes 10, and a noise of 0.2 rad/s a step to make up for what I
do not know. The encoder's 0.05 rad are right. The env cuts the rate at 8 rad/s, which the model leaves out.

Source: the env's page at gymnasium.farama.org.
"""

import math
from typing import NamedTuple

from filters import StateSpaceModel
from tuning.problems.env_problem import EnvProblem
from tuning.problems.problem import Parameter

ENCODER = 0.05  # deviation [rad]


class Constants(NamedTuple):
    """Numbers of the pendulum."""

    dt: float
    gravity: float  # [m/s^2]


def swing(x, u, c):
    """Angle and rate one step later, as the env integrates."""
    rate = x[1] + c.dt * (1.5 * c.gravity * math.sin(x[0]) + 3.0 * u[0])
    return (x[0] + c.dt * rate, rate)


def look(x, c):
    """The angle."""
    return (x[0],)


def model(gravity=9.81, sigma=0.2):
    """The pendulum with some gravity [m/s^2] and a noise of the rate a step [rad/s]."""
    dt = 0.05
    return StateSpaceModel(
        transition=swing,
        observe=look,
        constants=Constants(dt, gravity),
        process_noise_cov=[(dt * sigma) ** 2, sigma**2],
        measurement_noise_cov=[ENCODER**2],
        prior_mean=[0.0, 0.0],
        prior_cov=[3.0, 0.5],
        states=[("angle", "theta", "rad", True), ("angular rate", "omega", "rad/s")],
        input_quantities=[("torque", "tau", "N m")],
        measurements=[("encoder", "z", "rad", True)],
    )


def encoder(observation, info):
    """The angle, of the env's cosine and sine."""
    return [math.atan2(observation[1], observation[0])]


def state(env):
    """The truth."""
    return env.state


problem = EnvProblem(
    "Pendulum-v1",
    {"name": "steps", "amplitude": 2.0, "hold": 10},
    model,
    state_of=state,
    measure=encoder,
    measurement_noise_cov=[ENCODER**2],
    dt=0.05,
    parameters=[
        Parameter("gravity", 8.0, 12.0, unit="m/s^2", log=False, default=9.81),
        Parameter("sigma", 1e-3, 3.0, unit="rad/s", default=0.2),
    ],
    name="pendulum",
    about="Gymnasium's pendulum with an encoder; gravity is tuned beside the noise",
)
