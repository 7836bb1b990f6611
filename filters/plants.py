"""Nonlinear models that users bring: vehicles in a plane, a pendulum, a motor, a tank, a heated room, a battery.

Each function makes a `ContinuousModel` of a few physical numbers; `.at(dt)` is its model of a sample time:

    from filters import make_filter, plants

    filter_ = make_filter("ukf", plants.pendulum(length=0.4).at(0.01))

White noise drives what the equations leave out: a force, a torque, a leak. Its size is the root of its spectral
density: after t seconds it has moved the state by that times sqrt(t). All numbers are arguments, so that
`tuning.identify(plants.pendulum, log)` and `thruster identify --model pendulum` find them in a log.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from filters.inertial import attitude, attitude_imu, heave, inertial_navigation
from thruster_env.core.checks import one_of, positive, short_repr
from thruster_env.core.equal_functions import makes_functions
from thruster_env.model.continuous import ContinuousModel

GRAVITY = 9.81  # [m/s^2]
POSITION, RANGE_BEARING = "position", "range-bearing"
SENSORS = POSITION, RANGE_BEARING
FINE = 0.05  # longest Runge-Kutta step, in time constants or in turns of a radian
HEADING = ("heading", "psi", "rad", True)


class Plane(NamedTuple):
    """Numbers of a vehicle and its sensor."""

    sensor_x: float
    sensor_y: float
    wheelbase: float
    substep: float


def _position(x, c):
    return (x[0], x[1])


def _range_bearing(x, c):
    east, north = x[0] - c.sensor_x, x[1] - c.sensor_y
    return (math.hypot(east, north), math.atan2(north, east))


def _vehicle(
    rates: Callable,
    densities: Sequence[float],
    prior: tuple[Sequence[float], Sequence[float]],
    states: Sequence[tuple],
    inputs: Sequence[tuple],
    sensors: str,
    stds: tuple[float, float],
    sensor: tuple[float, float],
    wheelbase: float = 1.0,
) -> ContinuousModel:
    """A vehicle with its sensor; `stds` are deviations of a position or range [m] and of a bearing [rad]."""
    position_std, bearing_std = positive("position_std", stds[0]), positive("bearing_std", stds[1])
    channels: list[tuple]
    if one_of("sensors", sensors, SENSORS) == POSITION:
        channels, noise = [("measured easting", "z_x", "m"), ("measured northing", "z_y", "m")], position_std
    else:
        channels, noise = [("range", "r", "m"), ("bearing", "b", "rad", True)], bearing_std
    return ContinuousModel(
        rates=rates,
        observe=_position if sensors == POSITION else _range_bearing,
        densities=[density**2 for density in densities],
        constants=Plane(*sensor, positive("wheelbase", wheelbase), 1.0),
        longest=0.5,
        arguments={
            "prior_mean": prior[0],
            "prior_cov": [deviation**2 for deviation in prior[1]],
            "measurement_noise_cov": [position_std**2, noise**2],
            "states": [("easting", "x", "m"), ("northing", "y", "m"), *states],
            "input_quantities": list(inputs),
            "measurements": channels,
        },
    )


def _turning(x, u, c):
    return (x[2] * math.cos(x[3]), x[2] * math.sin(x[3]), 0.0, x[4], 0.0)


def coordinated_turn(
    speed: float = 10.0,
    acceleration: float = 0.5,
    turn_acceleration: float = 0.05,
    position_std: float = 3.0,
    bearing_std: float = 0.01,
    sensors: str = POSITION,
    sensor_x: float = 0.0,
    sensor_y: float = 0.0,
) -> ContinuousModel:
    """A target that turns: speed and turn rate walk at random.

        x' = v cos(psi),  y' = v sin(psi),  v' = w_v,  psi' = w,  w' = w_w

    Args:
        speed: typical v [m/s], its prior.
        acceleration: root density of w_v [m/s^2/sqrt(Hz)].
        turn_acceleration: root density of w_w [rad/s^2/sqrt(Hz)].
        position_std: deviation of a measured position, or of the range [m].
        bearing_std: deviation of the bearing [rad].
        sensors: "position", or "range-bearing" from the sensor.
        sensor_x: easting of the sensor [m].
        sensor_y: northing of the sensor [m].

    Source: Bar-Shalom, Li, Kirubarajan (2001), Estimation with Applications to Tracking and Navigation, 11.7.
    """
    states = [("speed", "v", "m/s"), HEADING, ("turn rate", "w", "rad/s")]
    prior = [0.0, 0.0, positive("speed", speed), 0.0, 0.0], [1e3, 1e3, speed, 2.0, 0.3]
    densities = [0.0, 0.0, acceleration, 0.0, turn_acceleration]
    sensor = sensor_x, sensor_y
    return _vehicle(_turning, densities, prior, states, [], sensors, (position_std, bearing_std), sensor)


def _rolling(x, u, c):
    return (u[0] * math.cos(x[2]), u[0] * math.sin(x[2]), u[1])


def unicycle(
    slip: float = 0.05,
    turn_slip: float = 0.02,
    position_std: float = 3.0,
    bearing_std: float = 0.01,
    sensors: str = POSITION,
    sensor_x: float = 0.0,
    sensor_y: float = 0.0,
) -> ContinuousModel:
    """A robot on two wheels, whose odometry is the input.

        x' = v cos(psi) + w_x,  y' = v sin(psi) + w_y,  psi' = w + w_psi

    Args:
        slip: root density of w_x and w_y [m/s/sqrt(Hz)].
        turn_slip: root density of w_psi [rad/s/sqrt(Hz)].
        position_std: deviation of a measured position, or of the range [m].
        bearing_std: deviation of the bearing [rad].
        sensors: "position", or "range-bearing" from the sensor.
        sensor_x: easting of the sensor [m].
        sensor_y: northing of the sensor [m].

    Source: Thrun, Burgard, Fox (2005), Probabilistic Robotics, section 5.4.
    """
    prior, inputs = ([0.0, 0.0, 0.0], [1e2, 1e2, 2.0]), [("speed", "v", "m/s"), ("turn rate", "w", "rad/s")]
    stds, sensor = (position_std, bearing_std), (sensor_x, sensor_y)
    return _vehicle(_rolling, [slip, slip, turn_slip], prior, [HEADING], inputs, sensors, stds, sensor)


def _steered(x, u, c):
    return (u[0] * math.cos(x[2]), u[0] * math.sin(x[2]), u[0] * math.tan(u[1]) / c.wheelbase)


def bicycle(
    wheelbase: float = 2.7,
    slip: float = 0.1,
    turn_slip: float = 0.02,
    position_std: float = 3.0,
    bearing_std: float = 0.01,
    sensors: str = POSITION,
    sensor_x: float = 0.0,
    sensor_y: float = 0.0,
) -> ContinuousModel:
    """A car, whose speed and steering angle are the inputs; x, y are of the rear axle.

        x' = v cos(psi) + w_x,  y' = v sin(psi) + w_y,  psi' = v tan(delta)/L + w_psi

    Args:
        wheelbase: L [m].
        slip: root density of w_x and w_y [m/s/sqrt(Hz)].
        turn_slip: root density of w_psi [rad/s/sqrt(Hz)].
        position_std: deviation of a measured position, or of the range [m].
        bearing_std: deviation of the bearing [rad].
        sensors: "position", or "range-bearing" from the sensor.
        sensor_x: easting of the sensor [m].
        sensor_y: northing of the sensor [m].

    Source: Rajamani (2012), Vehicle Dynamics and Control, section 2.2.
    """
    prior, inputs = ([0.0, 0.0, 0.0], [1e2, 1e2, 2.0]), [("speed", "v", "m/s"), ("steering angle", "delta", "rad")]
    stds, sensor = (position_std, bearing_std), (sensor_x, sensor_y)
    return _vehicle(_steered, [slip, slip, turn_slip], prior, [HEADING], inputs, sensors, stds, sensor, wheelbase)


class Swing(NamedTuple):
    """Numbers of a pendulum."""

    length: float
    damping: float
    inertia: float
    substep: float


def _swinging(x, u, c):
    return (x[1], -GRAVITY / c.length * math.sin(x[0]) - c.damping * x[1] + u[0] / c.inertia)


def _first_state(x, c):
    return (x[0],)


def pendulum(
    length: float = 1.0,
    damping: float = 0.1,
    mass: float = 1.0,
    torque: float = 0.1,
    angle_std: float = 0.01,
) -> ContinuousModel:
    """A pendulum with a motor on its axis and an encoder; theta is zero at rest.

        theta'' = -g/l sin(theta) - d theta' + (u + w)/(m l^2)

    Args:
        length: l [m].
        damping: d [1/s].
        mass: m [kg].
        torque: root density of w [N m/sqrt(Hz)].
        angle_std: deviation of the encoder [rad].

    Source: Khalil (2002), Nonlinear Systems, section 1.2.1.
    """
    inertia = positive("mass", mass) * positive("length", length) ** 2
    return ContinuousModel(
        rates=_swinging,
        observe=_first_state,
        densities=[0.0, (torque / inertia) ** 2],
        constants=Swing(length, damping, inertia, 1.0),
        longest=FINE * math.sqrt(length / GRAVITY),
        arguments={
            "prior_mean": [0.0, 0.0],
            "prior_cov": [1.0, GRAVITY / length],
            "measurement_noise_cov": [angle_std**2],
            "states": [("angle", "theta", "rad", True), ("angular rate", "omega", "rad/s")],
            "input_quantities": [("torque", "tau", "N m")],
            "measurements": [("encoder", "z", "rad", True)],
        },
    )


class Motor(NamedTuple):
    """Numbers of a motor."""

    gain: float
    time_constant: float
    friction: float
    substep: float


def _running(x, u, c):
    return (x[1], (c.gain * u[0] - x[1] - c.friction * math.tanh(x[1])) / c.time_constant)


def dc_motor(
    gain: float = 10.0,
    time_constant: float = 0.1,
    friction: float = 0.5,
    torque: float = 1.0,
    angle_std: float = 0.01,
) -> ContinuousModel:
    """A direct-current motor with an encoder and dry friction, whose current follows the voltage at once.

        theta' = w,  T w' = K u - w - w_f tanh(w/(1 rad/s)) + T w_w

    Args:
        gain: K, steady speed per volt [rad/(s V)].
        time_constant: T of the speed [s].
        friction: w_f, the speed that dry friction takes [rad/s].
        torque: root density of w_w, as an acceleration [rad/s^2/sqrt(Hz)].
        angle_std: deviation of the encoder [rad].

    Source: Astrom, Murray (2021), Feedback Systems, section 3.3; dry friction smoothed as in Olsson and others
    (1998), "Friction models and friction compensation".
    """
    return ContinuousModel(
        rates=_running,
        observe=_first_state,
        densities=[0.0, torque**2],
        constants=Motor(gain, positive("time_constant", time_constant), friction, 1.0),
        longest=FINE * time_constant,
        arguments={
            "prior_mean": [0.0, 0.0],
            "prior_cov": [1.0, (10.0 * gain) ** 2],
            "measurement_noise_cov": [angle_std**2],
            "states": [("angle", "theta", "rad"), ("speed", "w", "rad/s")],
            "input_quantities": [("voltage", "u", "V")],
            "measurements": [("encoder", "z", "rad")],
        },
    )


class Vessel(NamedTuple):
    """Numbers of a tank."""

    area: float
    outlet: float
    substep: float


def _draining(x, u, c):
    return ((u[0] - c.outlet * math.sqrt(2.0 * GRAVITY * max(x[0], 1e-6))) / c.area,)


def tank(
    area: float = 1.0,
    outlet: float = 0.01,
    leak: float = 0.001,
    level_std: float = 0.01,
    level: float = 1.0,
) -> ContinuousModel:
    """A tank that is filled at a known rate and drains through an outlet.

        A h' = q - a sqrt(2 g h) + A w

    Args:
        area: A [m^2].
        outlet: a, the effective area of the outlet [m^2].
        leak: root density of w [m/s/sqrt(Hz)].
        level_std: deviation of the measured level [m].
        level: typical h [m], its prior.

    Source: Johansson (2000), "The quadruple-tank process", IEEE Transactions on Control Systems Technology 8(3).
    """
    emptying = (
        positive("area", area) / positive("outlet", outlet) * math.sqrt(2.0 * positive("level", level) / GRAVITY)
    )
    return ContinuousModel(
        rates=_draining,
        observe=_first_state,
        densities=[leak**2],
        constants=Vessel(area, outlet, 1.0),
        longest=FINE * emptying,
        arguments={
            "prior_mean": [level],
            "prior_cov": [level**2],
            "measurement_noise_cov": [level_std**2],
            "states": [("level", "h", "m")],
            "input_quantities": [("inflow", "q", "m^3/s")],
            "measurements": [("measured level", "z", "m")],
        },
    )


class Room(NamedTuple):
    """Numbers of a heated room."""

    resistance: float
    capacity: float
    substep: float


def _heated(x, u, c):
    return (((u[1] - x[0]) / c.resistance + u[0]) / c.capacity,)


def rc_thermal(
    resistance: float = 0.005,
    capacity: float = 5e6,
    power: float = 1e4,
    temperature_std: float = 0.2,
) -> ContinuousModel:
    """A room, or a device, with one heat capacity behind one thermal resistance.

        C T' = (T_a - T)/R + P + w

    Args:
        resistance: R [K/W].
        capacity: C [J/K].
        power: root density of w [W/sqrt(Hz)]: people, the sun, windows.
        temperature_std: deviation of the thermometer [K].

    Source: Bacher, Madsen (2011), "Identifying suitable models for the heat dynamics of buildings", Energy and
    Buildings 43(7), its simplest model.
    """
    time_constant = positive("resistance", resistance) * positive("capacity", capacity)
    return ContinuousModel(
        rates=_heated,
        observe=_first_state,
        densities=[(power / capacity) ** 2],
        constants=Room(resistance, capacity, 1.0),
        longest=FINE * time_constant,
        arguments={
            "prior_mean": [20.0],
            "prior_cov": [100.0],
            "measurement_noise_cov": [temperature_std**2],
            "states": [("temperature", "T", "degC")],
            "input_quantities": [("heating", "P", "W"), ("ambient temperature", "T_a", "degC")],
            "measurements": [("thermometer", "z", "degC")],
        },
    )


class Cell(NamedTuple):
    """Numbers of a battery's cell."""

    capacity: float
    series: float
    polarisation: float
    time_constant: float
    substep: float


# Of a lithium cell with a cathode of nickel, manganese and cobalt: charge, and voltage at rest [V].
OPEN_CIRCUIT = (
    *((0.0, 3.0), (0.05, 3.35), (0.1, 3.45), (0.2, 3.55), (0.3, 3.6), (0.4, 3.64), (0.5, 3.7)),
    *((0.6, 3.8), (0.7, 3.9), (0.8, 4.0), (0.9, 4.08), (1.0, 4.18)),
)


def _discharging(x, u, c):
    return (-u[0] / (3600.0 * c.capacity), (c.polarisation * u[0] - x[1]) / c.time_constant)


@makes_functions
def _terminal_voltage(charges: tuple[float, ...], voltages: tuple[float, ...]) -> Callable:
    def observe(x, u, c):
        return (np.interp(x[0], charges, voltages) - x[1] - c.series * u[0],)

    return observe


def battery(
    capacity: float = 2.5,
    series: float = 0.03,
    polarisation: float = 0.02,
    time_constant: float = 30.0,
    charge_drift: float = 1e-5,
    voltage_drift: float = 1e-4,
    voltage_std: float = 5e-3,
    open_circuit: Sequence[tuple[float, float]] = OPEN_CIRCUIT,
) -> ContinuousModel:
    """A cell with one pair of resistance and capacitance, whose current is the input, positive in discharge.

        s' = -i/C + w_s,  v' = (R_1 i - v)/T + w_v;   z = E(s) - v - R_0 i

    Args:
        capacity: C [A h].
        series: R_0 [ohm].
        polarisation: R_1 [ohm].
        time_constant: T [s].
        charge_drift: root density of w_s [1/sqrt(s)].
        voltage_drift: root density of w_v [V/sqrt(s)].
        voltage_std: deviation of the voltmeter [V].
        open_circuit: E, pairs of charge and voltage [V] in ascending order, linear between them: your cell's.

    Raises:
        ValueError: unless charges and voltages ascend.

    Source: Plett (2015), Battery Management Systems, volume 1, sections 2.3 to 2.5.
    """
    charges, voltages = zip(*((float(s), float(v)) for s, v in open_circuit), strict=True)
    if len(charges) < 2 or (np.diff([charges, voltages]) <= 0.0).any():
        raise ValueError(f"open_circuit must ascend in charge and voltage, but got {short_repr(open_circuit)}")
    return ContinuousModel(
        rates=_discharging,
        observe=_terminal_voltage(charges, voltages),
        densities=[charge_drift**2, voltage_drift**2],
        constants=Cell(positive("capacity", capacity), series, polarisation, time_constant, 1.0),
        longest=0.2 * positive("time_constant", time_constant),
        arguments={
            "prior_mean": [0.5, 0.0],
            "prior_cov": [0.1, 1e-3],
            "measurement_noise_cov": [voltage_std**2],
            "states": [("charge", "s", ""), ("overvoltage", "v", "V")],
            "input_quantities": [("current", "i", "A")],
            "measurements": [("terminal voltage", "z", "V")],
        },
    )


# Functions of numbers that make a model in continuous time, or one of a sample time dt.
PLANTS: Mapping[str, Callable[..., Any]] = {
    "attitude": attitude,
    "attitude-imu": attitude_imu,
    "inertial-navigation": inertial_navigation,
    "heave": heave,
    "coordinated-turn": coordinated_turn,
    "unicycle": unicycle,
    "bicycle": bicycle,
    "pendulum": pendulum,
    "dc-motor": dc_motor,
    "battery": battery,
    "tank": tank,
    "rc-thermal": rc_thermal,
}
