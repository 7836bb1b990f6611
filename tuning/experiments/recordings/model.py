"""What is assumed of the recorded ROV thruster: a motor, the water that it moves, its tachometer and its mount.

    dn/dt = k_n (g d(u) - n)                             motor speed n [rad/s] under the command u [V]
    dy/dt = (n - y)/tau                                  what the tachometer shows, but for the sign
    B = e(n) (c_n n|n| - c_v (v - v_a)|n|)               thrust of the blades [N]
    T = B + a dn/dt                                      thrust on the water [N]
    dv/dt = -k_v v - k_vv v|v| + k_t B                   axial flow v [m/s]
    d2q/dt2 = w^2 (T - q) - 2 zeta w dq/dt               what the mount passes on [N]

with d(u) = u - high above the dead band, b (u - low) below it and 0 within; e(n) = 1 ahead and e astern. The load
cell shows T + m (q - T). An effect whose constant is neutral is not there: a, m, c_v of 0; b, e of 1.

v has no scale of its own where only thrust is measured: c_v, k_vv and k_t change with it. k_t is therefore held.

Source of motor, dead band, blades and flow: J. A. Boehm (2019), MSc thesis, University of Maryland. The numbers of
`identified.toml` are ours, found from the recordings (docs/real_data.md).
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

from thruster_env.core.integration import runge_kutta
from thruster_env.model.quantities import Output, Quantity
from thruster_env.model.state_space import StateSpaceModel
from tuning.identification.result import read_values, valued

DT = 0.04  # of the recordings [s]
SUBSTEPS = 4  # of 10 ms: stable for rates of up to 278 1/s
IDENTIFIED = Path(__file__).with_name("identified.toml")


class Constants(NamedTuple):
    """Numbers of the model; those given here are round ones to start from."""

    motor_rate: float = 60.0  # k_n [1/s]
    motor_gain: float = 51.0  # g [rad/(s V)]
    gain_ratio: float = 1.0  # b
    dead_band_low: float = -0.8  # [V]
    dead_band_high: float = 0.8  # [V]
    tachometer_lag: float = 0.04  # tau [s]
    thrust_factor: float = 1.5e-3  # c_n [N s^2]
    thrust_ratio: float = 1.05  # e
    flow_factor: float = 0.4  # c_v [N s^2/m]
    flow_linear: float = 1.0  # k_v [1/s]
    flow_quadratic: float = 20.0  # k_vv [1/m]
    flow_gain: float = 0.03  # k_t [1/kg]
    ambient_factor: float = 0.0  # v_a over the measured ambient flow
    inertia: float = 0.0  # a [N s^2]
    mount_share: float = 0.0  # m
    mount_frequency: float = 14.0  # w/2 pi [Hz]
    mount_damping: float = 0.1  # zeta
    substep: float = DT / SUBSTEPS  # [s]


STATES = (
    Quantity("motor speed", "n", "rad/s"),
    Quantity("tachometer speed", "y", "rad/s"),
    Quantity("axial flow", "v", "m/s"),
    Quantity("effective command", "d", "V"),
)
MOUNT = (
    Quantity("force in the mount", "q", "N"),
    Quantity("rate of the force in the mount", "r", "N/s"),
)
INITIAL = (30.0, 30.0, 0.03, 0.0), (5.0, 200.0)  # standard deviations, of the mount last
PROCESS = (5.0, 1.0, 3e-3, 0.0), (0.0, 0.0)  # standard deviations of the noise of a step
COMMAND = Quantity("command", "u", "V")
AMBIENT = Quantity("measured ambient flow", "flow", "m/s")
TACHOMETER = Quantity("motor speed without its sign", "tach", "rad/s")
LOAD_CELL = Quantity("load cell", "load", "N")
SENSORS = (1.8, 1.0)  # standard deviations of tachometer [rad/s] and load cell [N]


def effective(command, c):
    """The command beyond the dead band [V]."""
    if command > c.dead_band_high:
        return command - c.dead_band_high
    if command < c.dead_band_low:
        return c.gain_ratio * (command - c.dead_band_low)
    return 0.0


def blades(n, v, c):
    """Thrust of the blades at a speed and a flow through them [N]."""
    side = 1.0 + (c.thrust_ratio - 1.0) * (n < 0.0)
    return side * (c.thrust_factor * n * abs(n) - c.flow_factor * v * abs(n))


def acceleration(x, c):
    """Of the motor [rad/s^2]."""
    return c.motor_rate * (c.motor_gain * x[3] - x[0])


def thrust(x, c):
    """Thrust on the water [N]."""
    return blades(x[0], x[2], c) + c.inertia * acceleration(x, c)


def through_mount(x, c):
    """What the load cell shows where the mount swings [N]."""
    return thrust(x, c) * (1.0 - c.mount_share) + c.mount_share * x[4]


def rates(x, u, c):
    """How fast the state changes under u = (effective command, ambient flow)."""
    lift = blades(x[0], x[2] - c.ambient_factor * u[1], c)
    return (
        acceleration(x, c),
        (x[0] - x[1]) / c.tachometer_lag,
        c.flow_gain * lift - (c.flow_linear + c.flow_quadratic * abs(x[2])) * x[2],
        0.0,
    )


def rates_with_mount(x, u, c):
    """How fast the state and the force in the mount change."""
    w = 2.0 * math.pi * c.mount_frequency
    swing = w * w * (thrust(x, c) - x[4]) - 2.0 * c.mount_damping * w * x[5]
    dn, dy, dv, dd = rates(x, u, c)
    return dn, dy, dv, dd, x[5], swing


_step, _step_with_mount = runge_kutta(rates, 4), runge_kutta(rates_with_mount, 6)


def transition(x, u, c):
    """One of the equal parts of a step under the command."""
    return _step((x[0], x[1], x[2], effective(u[0], c)), (u[0], 0.0), c)


def transition_in_flow(x, u, c):
    """One of the equal parts of a step under command and measured ambient flow."""
    return _step((x[0], x[1], x[2], effective(u[0], c)), (u[0], u[1]), c)


def transition_with_mount(x, u, c):
    """One of the equal parts of a step of thruster and mount."""
    return _step_with_mount((x[0], x[1], x[2], effective(u[0], c), x[4], x[5]), (u[0], 0.0), c)


def tachometer(x, c):
    """What the tachometer shows."""
    return (abs(x[1]),)


def tachometer_and_load(x, c):
    """What tachometer and load cell show."""
    return (abs(x[1]), thrust(x, c))


def tachometer_and_mount(x, c):
    """What tachometer and load cell show where the mount swings."""
    return (abs(x[1]), through_mount(x, c))


def to_identify(ambient: bool = False, mount: bool = False) -> StateSpaceModel:
    """The model with the load cell among its channels and round numbers, from which identification starts.

    Args:
        ambient: whether the measured ambient flow is an input.
        mount: whether the mount swings, which is two states more; not along with ambient flow.
    """
    parts = 1 + mount
    move = transition_with_mount if mount else transition_in_flow if ambient else transition
    return StateSpaceModel(
        transition=move,
        observe=tachometer_and_mount if mount else tachometer_and_load,
        process_noise_cov=[deviation**2 for part in PROCESS[:parts] for deviation in part],
        measurement_noise_cov=[deviation**2 for deviation in SENSORS],
        prior_mean=[0.0] * (4 + 2 * mount),
        prior_cov=[deviation**2 for part in INITIAL[:parts] for deviation in part],
        inputs=1 + ambient,
        constants=Constants(),
        substeps=SUBSTEPS,
        states=STATES + MOUNT * mount,
        input_quantities=(COMMAND, AMBIENT)[: 1 + ambient],
        measurements=(TACHOMETER, LOAD_CELL),
        outputs={"T": Output(Quantity("thrust", "T", "N"), thrust)},
    )


def on_line(identified: StateSpaceModel) -> StateSpaceModel:
    """An identified model as a filter has it that sees the tachometer alone."""
    r = identified.measurement_noise_cov[:1, :1]
    return identified.replace(observe=tachometer, measurements=(TACHOMETER,), measurement_noise_cov=r)


def model() -> StateSpaceModel:
    """The thruster with the numbers of `identified.toml`, for a filter that sees command and tachometer.

    Its output T is the thrust; a load cell's column may be its reference (`--column T=HEADER`).
    """
    return on_line(valued(to_identify(), read_values(IDENTIFIED)))
