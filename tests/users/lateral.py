"""A car's lateral motion from gyroscope and accelerometer: a stiffness is tuned beside the noise.

    m (v' + V r) = F_f + F_r + m g phi,   I r' = l_f F_f - l_r F_r,   delta' = (u - delta)/tau,   phi and b walk,
    F_f = -C_f ((v + l_f r)/V - delta),   F_r = -C_r (v - l_r r)/V;   z = (r + b, (F_f + F_r)/m)

at a constant V = 25 m/s; phi is the bank of the road, b the bias of the gyroscope. The steering's lag makes the
wheel's angle a state, so that the accelerometer sees states alone.

What I had: cornering stiffnesses of a table, small noise. The car's tyres saturate, F = -D tanh(C alpha/D) with
D of a wet road (0.85 of the load), and are stiffer in front than the table says.

Source: R. Rajamani (2012), Vehicle Dynamics and Control, 2nd ed., section 2.3; numbers of a mid-size car.
"""

import math
from typing import NamedTuple

from filters import StateSpaceModel
from thruster_env.core.derivatives import runge_kutta
from tuning.problems.model_problem import ModelProblem
from tuning.problems.problem import Parameter

DT = 0.02  # [s]


class Constants(NamedTuple):
    """Numbers of the car."""

    substep: float
    front: float  # C_f, of the axle [N/rad]
    rear: float  # C_r [N/rad]
    grip: float  # of the road; 0 for tyres that do not saturate
    speed: float = 25.0  # V [m/s]
    mass: float = 1500.0  # m [kg]
    inertia: float = 2500.0  # I [kg m^2]
    to_front: float = 1.2  # l_f [m]
    to_rear: float = 1.4  # l_r [m]
    lag: float = 0.08  # tau of the steering [s]


def force(stiffness, slip, most):
    """Force of an axle [N] at a slip angle [rad], of at most `most` [N]; without a limit if that is 0."""
    if most == 0.0:
        return -stiffness * slip
    return -most * math.tanh(stiffness * slip / most)


def forces(x, c):
    """Lateral forces of both axles [N]."""
    lateral, yaw, wheel = x[0], x[1], x[2]
    weight = c.grip * c.mass * 9.81 / (c.to_front + c.to_rear)
    front = force(c.front, (lateral + c.to_front * yaw) / c.speed - wheel, weight * c.to_rear)
    return front, force(c.rear, (lateral - c.to_rear * yaw) / c.speed, weight * c.to_front)


def rates(x, u, c):
    """Of lateral speed, yaw rate, wheel angle, bank and bias under a commanded angle u [rad]."""
    front, rear = forces(x, c)
    return (
        (front + rear) / c.mass + 9.81 * x[3] - c.speed * x[1],
        (c.to_front * front - c.to_rear * rear) / c.inertia,
        (u[0] - x[2]) / c.lag,
        0.0 * x[3],
        0.0 * x[4],
    )


def look(x, c):
    """Gyroscope and accelerometer."""
    front, rear = forces(x, c)
    return (x[1] + x[4], (front + rear) / c.mass)


def model(front=8e4, sigma_v=0.01, sigma_r=0.002, sigma_bank=5e-4, grip=0.0):
    """The car with a front stiffness [N/rad] and deviations a step [m/s, rad/s, rad]; grip of the truth only."""
    return StateSpaceModel(
        transition=move,
        observe=look,
        constants=Constants(DT, front, 9e4, grip),
        process_noise_cov=[sigma_v**2, sigma_r**2, 1e-8, sigma_bank**2, 1e-10],
        measurement_noise_cov=[0.01**2, 0.3**2],
        prior_mean=[0.0] * 5,
        prior_cov=[0.04, 1e-3, 1e-6, 1e-3, 1e-4],
        states=[
            ("lateral speed", "v", "m/s"),
            ("yaw rate", "r", "rad/s"),
            ("wheel angle", "delta", "rad"),
            ("bank", "phi", "rad"),
            ("gyroscope's bias", "b", "rad/s"),
        ],
        input_quantities=[("steering", "u", "rad")],
        measurements=[("gyroscope", "z_r", "rad/s"), ("accelerometer", "z_a", "m/s^2")],
    )


move = runge_kutta(rates, 5)
problem = ModelProblem(
    model(front=9.5e4, sigma_v=0.01, sigma_r=0.001, sigma_bank=5e-4, grip=0.85),
    model,
    inputs={"name": "steps", "amplitude": 0.02, "hold": 40},
    steps=300,
    dt=DT,
    scale=(0.1, 0.005, 1e-3, 0.01, 0.005),
    parameters=[
        Parameter("front", 4e4, 2e5, unit="N/rad", default=8e4),
        Parameter("sigma_v", 1e-4, 1.0, unit="m/s", default=0.01),
        Parameter("sigma_r", 1e-5, 0.1, unit="rad/s", default=0.002),
        Parameter("sigma_bank", 1e-5, 0.01, unit="rad", default=5e-4),
    ],
    name="lateral",
    about="a car on a wet road: tyres that saturate, taken for linear; a stiffness is tuned beside the noise",
)
