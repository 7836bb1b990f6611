"""A ship seen by a harbour's radar in range and bearing: speed, course and turn rate of a target that steers.

    x' = v cos(psi),   y' = v sin(psi),   psi' = w;   v and w walk at random

What I had: two deviations by guess, 0.02 m/s and 2e-3 rad/s a scan, and the radar's data sheet, 10 m and 0.5
deg. In truth ranges scatter more (the ship is 60 m long), bearings less. The ship passes behind the radar, where
bearings jump from pi to -pi, and its course is an angle, too.

Source: Y. Bar-Shalom, X.-R. Li, T. Kirubarajan (2001), Estimation with Applications to Tracking and Navigation,
section 11.7.
"""

import math
from typing import NamedTuple

from filters import StateSpaceModel
from tuning.problems.model_problem import ModelProblem
from tuning.problems.problem import Parameter

DT = 3.0  # a turn of the antenna [s]
DEGREE = math.pi / 180.0


class Constants(NamedTuple):
    """Numbers of the motion."""

    dt: float = DT


def move(x, u, c):
    """The ship one scan later, on the chord of its turn."""
    east, north, speed, course, turn = x
    middle = course + 0.5 * c.dt * turn
    return (
        east + c.dt * speed * math.cos(middle),
        north + c.dt * speed * math.sin(middle),
        speed,
        course + c.dt * turn,
        turn,
    )


def look(x, c):
    """Range and bearing from the radar at the origin."""
    return (math.hypot(x[0], x[1]), math.atan2(x[1], x[0]))


def model(sigma_speed=0.02, sigma_turn=2e-3, sigma_range=10.0, sigma_bearing=0.5 * DEGREE):
    """The ship; deviations of speed [m/s] and turn rate [rad/s] a scan, of range [m] and bearing [rad]."""
    return StateSpaceModel(
        transition=move,
        observe=look,
        constants=Constants(),
        inputs=0,
        process_noise_cov=[0.1, 0.1, sigma_speed**2, 1e-6, sigma_turn**2],
        measurement_noise_cov=[sigma_range**2, sigma_bearing**2],
        prior_mean=[-1200.0, 1500.0, 8.0, -math.pi / 2, 0.0],
        prior_cov=[50.0**2, 50.0**2, 1.0, 0.04, 1e-5],
        states=[
            ("easting", "x", "m"),
            ("northing", "y", "m"),
            ("speed", "v", "m/s"),
            ("course", "psi", "rad", True),
            ("turn rate", "w", "rad/s"),
        ],
        measurements=[("range", "r", "m"), ("bearing", "b", "rad", True)],
    )


problem = ModelProblem(
    model(sigma_speed=0.1, sigma_turn=7e-4, sigma_range=15.0, sigma_bearing=0.3 * DEGREE),
    model,
    steps=200,
    dt=DT,
    scale=(2.0, 2.0, 0.2, 0.02, 2e-3),
    parameters=[
        Parameter("sigma_speed", 1e-3, 1.0, unit="m/s", default=0.02),
        Parameter("sigma_turn", 1e-5, 1e-2, unit="rad/s", default=2e-3),
    ],
    name="range-bearing",
    about="a ship on the radar, whose range and bearing are not quite those of the data sheet",
)
