"""What is assumed of the recorded ROV thruster: a motor, the water that it moves, its tachometer and its mount.

    dn/dt = k_n (g d(u) - n)                                motor speed n [rad/s] under the command u [V]
    dy/dt = (n - y) / tau                                   what the tachometer shows, without its sign
    T = e(n) (c_n n|n| - c_v (v - v_a)|n|) + a dn/dt        thrust on the water [N]
    dv/dt = -k_v v - k_vv v|v| + k_t (T - a dn/dt)          axial flow v [m/s]
    d2q/dt2 = w^2 (T - q) - 2 zeta w dq/dt                  what the mount passes on [N]

with d(u) = u - high above the dead band, b (u - low) below it, 0 within; e(n) = 1 ahead and e astern; the load cell
reads T + m (q - T). Effects whose constant is neutral (a, m or c_v of 0, e or b of 1) are not there.

The structure without mount and inertial force is J. A. Boehm's (2019); the numbers are found from the recordings.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from numerics.integration import runge_kutta
from plants.quantities import Output, Quantity
from plants.state_space import StateSpaceModel

DT = 0.04  # s, of the recordings
SUBSTEPS = 8  # of 5 ms: the mount swings at 14 Hz


class Constants(NamedTuple):
    """Numbers of the model, before anything is identified: those of the recorder's table, round."""

    motor_rate: float = 60.0  # k_n, 1/s
    motor_gain: float = 51.0  # g, rad/s per V
    gain_ratio: float = 1.0  # b, astern over ahead
    dead_band_low: float = -0.8  # V
    dead_band_high: float = 0.8
    tachometer_lag: float = 0.04  # tau, s
    thrust_factor: float = 1.5e-3  # c_n, N s^2
    thrust_ratio: float = 1.05  # e, astern over ahead
    flow_factor: float = 0.4  # c_v, N s^2/m
    flow_linear: float = 1.0  # k_v, 1/s
    flow_quadratic: float = 20.0  # k_vv, 1/m
    flow_gain: float = 0.03  # k_t, 1/kg
    ambient_factor: float = 0.0  # on the measured ambient flow
    inertia: float = 0.0  # a, N s^2
    mount_share: float = 0.0  # m
    mount_frequency: float = 14.0  # Hz
    mount_damping: float = 0.1  # zeta
    thrust_offset: float = 0.0  # of the load cell, N
    substep: float = DT / SUBSTEPS


class Noise(NamedTuple):
    """Standard deviations of the noise, a step, and of the sensors."""

    motor: float = 5.0  # rad/s
    tachometer: float = 1.0  # rad/s
    flow: float = 0.003  # m/s
    mount: float = 30.0  # N/s
    tachometer_sensor: float = 1.8  # rad/s
    load_cell: float = 1.0  # N


STATES = (
    Quantity("motor speed", "n", "rad/s"),
    Quantity("tachometer's speed", "y", "rad/s"),
    Quantity("axial flow", "v", "m/s"),
    Quantity("effective command", "d", "V"),
    Quantity("mount force", "q", "N"),
    Quantity("rate of the mount force", "r", "N/s"),
)
INPUTS = (Quantity("command", "u", "V"), Quantity("measured ambient flow", "flow", "m/s"))
TACHOMETER = Quantity("motor speed without sign", "tach", "rad/s")
LOAD_CELL = Quantity("load cell", "load", "N")
INITIAL = (30.0, 30.0, 0.03, 0.0, 5.0, 200.0)  # standard deviations


def effective(u, c):
    """The command beyond the dead band [V]; astern of another weight."""
    if u > c.dead_band_high:
        return u - c.dead_band_high
    if u < c.dead_band_low:
        return c.gain_ratio * (u - c.dead_band_low)
    return 0.0


def lift(n, v, c):
    """Thrust of the blades at a speed and a flow [N]."""
    return (1.0 + (c.thrust_ratio - 1.0) * (n < 0.0)) * (c.thrust_factor * n * abs(n) - c.flow_factor * v * abs(n))


def acceleration(x, c):
    """Of the motor [rad/s^2]."""
    return c.motor_rate * (c.motor_gain * x[3] - x[0])


def thrust(x, c):
    """Thrust on the water [N]."""
    return lift(x[0], x[2], c) + c.inertia * acceleration(x, c)


def load(x, c):
    """What the load cell shows [N]."""
    return thrust(x, c) * (1.0 - c.mount_share) + c.mount_share * x[4] + c.thrust_offset


def rates(x, u, c):
    """How fast the state changes."""
    n, y, v, q, r = x[0], x[1], x[2], x[4], x[5]
    w = 2.0 * math.pi * c.mount_frequency
    blades = lift(n, v - c.ambient_factor * u[1], c)
    return (
        acceleration(x, c),
        (n - y) / c.tachometer_lag,
        -c.flow_linear * v - c.flow_quadratic * v * abs(v) + c.flow_gain * blades,
        0.0,
        r,
        w * w * (blades + c.inertia * acceleration(x, c) - q) - 2.0 * c.mount_damping * w * r,
    )


_step = runge_kutta(rates, len(STATES))


def transition(x, u, c):
    """One of the equal parts of a sample."""
    return _step((x[0], x[1], x[2], effective(u[0], c), x[4], x[5]), u, c)


def observe(x, c):
    """What tachometer and load cell show."""
    return (abs(x[1]), load(x, c))


def model(**values: float) -> StateSpaceModel:
    """The thruster with some of its constants and standard deviations of its noise, by their names.

    Args:
        **values: fields of `Constants` and of `Noise`; an unknown name is a TypeError.
    """
    noise = Noise(**{name: values.pop(name) for name in Noise._fields if name in values})
    return StateSpaceModel(
        transition=transition,
        observe=observe,
        process_noise_cov=[noise.motor**2, noise.tachometer**2, noise.flow**2, 0.0, 0.0, noise.mount**2],
        measurement_noise_cov=[noise.tachometer_sensor**2, noise.load_cell**2],
        prior_mean=[0.0] * len(STATES),
        prior_cov=[deviation**2 for deviation in INITIAL],
        inputs=len(INPUTS),
        constants=Constants(**values),
        substeps=SUBSTEPS,
        states=STATES,
        input_quantities=INPUTS,
        measurements=(TACHOMETER, LOAD_CELL),
        outputs={"T": Output(Quantity("thrust", "T", "N"), thrust)},
    )
