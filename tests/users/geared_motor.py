"""A DC motor that turns a load through an elastic gear: encoder at the load, tachometer at the motor.

    J_m w' = k (u - k w)/R - tau/N,   J_l v' = tau - d v [- T_c tanh(v/v_c)],   theta' = v,   phi' = w/N - v,
    tau = K phi + D (w/N - v)

What I had: a Q with noise on the two speeds alone, for angles follow from speeds exactly, and an encoder's R of
one count. The plant has dry friction at the load, which the model leaves out, and an encoder that is mounted a
little off centre.

Sources: data sheet of Maxon RE 40, 12 V winding (R 0.299 ohm, k 30.2 mN m/A, J 142 g cm^2); its inductance's 0.3
ms is left out. The gear, 43:1, 30 N m/rad, is such that load and motor swing at some 8 Hz against each other.
"""

import math
from typing import NamedTuple

from filters import StateSpaceModel
from thruster_env.core.derivatives import runge_kutta
from tuning.problems.model_problem import ModelProblem

DT = 0.005  # [s]


class Constants(NamedTuple):
    """Numbers of the drive."""

    substep: float = DT / 2  # of the integration [s]
    torque: float = 0.0302  # k [N m/A], also [V s/rad]
    resistance: float = 0.299  # R [ohm]
    motor: float = 1.42e-5  # J_m [kg m^2]
    load: float = 0.02  # J_l [kg m^2]
    ratio: float = 43.0  # N
    stiffness: float = 30.0  # K [N m/rad]
    damping: float = 0.05  # D [N m s/rad]
    viscous: float = 0.02  # d [N m s/rad]
    dry: float = 0.0  # T_c [N m]


def rates(x, u, c):
    """Of motor speed w, twist phi, load speed v and load angle theta, under a voltage u."""
    motor, twist, load, _ = x
    slip = motor / c.ratio - load
    torque = c.stiffness * twist + c.damping * slip
    driving = c.torque * (u[0] - c.torque * motor) / c.resistance
    resisting = c.viscous * load + c.dry * math.tanh(load / 0.1)
    return ((driving - torque / c.ratio) / c.motor, slip, (torque - resisting) / c.load, load)


def look(x, c):
    """Angle of the load and speed of the motor."""
    return (x[3], x[0])


def model(constants, motor, load, sensors):
    """The drive with noise of some deviations a step of the two speeds [rad/s], and sensors' deviations."""
    return StateSpaceModel(
        transition=move,
        observe=look,
        constants=constants,
        substeps=2,
        process_noise_cov=[motor**2, 0.0, load**2, 0.0],
        measurement_noise_cov=[one**2 for one in sensors],
        prior_mean=[0.0, 0.0, 0.0, 0.0],
        prior_cov=[1.0, 1e-4, 0.01, 0.1],
        state_low=[-400.0, -0.1, -10.0, -math.pi],
        state_high=[400.0, 0.1, 10.0, math.pi],
        states=[
            ("motor speed", "w", "rad/s"),
            ("twist", "phi", "rad"),
            ("load speed", "v", "rad/s"),
            ("load angle", "theta", "rad", True),
        ],
        input_quantities=[("voltage", "u", "V")],
        measurements=[("encoder", "z_theta", "rad", True), ("tachometer", "z_w", "rad/s")],
    )


move = runge_kutta(rates, 4)
problem = ModelProblem(
    model(Constants()._replace(dry=0.3), motor=0.5, load=0.01, sensors=(0.004, 3.0)),
    model(Constants(), motor=2.0, load=0.05, sensors=(0.0015, 3.0)),
    inputs={"name": "steps", "amplitude": 12.0, "hold": 40},
    steps=300,
    dt=DT,
    scale=(1.0, 2e-3, 0.05, 2e-3),
    name="geared-motor",
    about="a motor and its load behind an elastic gear, with dry friction that the model leaves out",
)
