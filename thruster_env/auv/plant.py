"""The noisy vehicle from plain arguments: its parameters, noise, sensors, limits and initial state.

Sensors of a vehicle: channels, instruments with their noise and rate, and suites of instruments.

Each channel is one of the states; x and y have two, for a position by sound and by satellites.

Disturbances of the vehicle: currents and sensor effects.

Forces on the vehicle are those of its velocity through the water; its state is the velocity over ground. A filter
whose model has no current takes it for a disturbance.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from thruster_env.auv.dynamics import angled_state, attitude_of, required_substeps
from thruster_env.auv.parameters import PRESETS, Constants, VehicleParameters, derive_constants, preset_parameters
from thruster_env.core.checks import at_least, between, finite, one_of, positive, short_repr, within
from thruster_env.core.equal_functions import makes_functions
from thruster_env.core.sources import tuple_of, written_out
from thruster_env.core.streams import cosine_and_sine
from thruster_env.effects.effects import (
    ConstantSignal,
    Effect,
    GaussMarkov,
    Gusts,
    RecordedSignal,
    Registry,
    Sinusoid,
    dropping_channels,
)
from thruster_env.effects.sensors import SENSOR_EFFECTS, SampleEvery, hold_missing
from thruster_env.env.copies import Channel
from thruster_env.env.plant_data import (
    Entries,
    check_same,
    checked_noise,
    data_of,
    initial_distribution,
    sensor_effects,
)
from thruster_env.model import rotations
from thruster_env.model.quantities import Quantity
from thruster_env.model.turns import Rotation

# The current that a vehicle goes in: signals to the north, to the east and down [m/s], the same everywhere.


DIRECTIONS = ("north", "east", "down")
FASTEST = 100.0  # [m/s]: beyond it there is no water
CURRENT_SIGNALS = Registry(
    "current",
    {
        "constant": ConstantSignal,
        "gauss-markov": GaussMarkov,
        "sinusoid": Sinusoid,
        "gusts": Gusts,
        "recorded": RecordedSignal,
    },
)

Current = dict[str, tuple[Effect, ...]]


def make_current(current) -> Current:
    """Signals by direction, from None, three numbers (north, east, down) [m/s] or a mapping from directions.

    Each entry of a mapping is a number or a list of signals of CURRENT_SIGNALS, which are added:
    {"north": 0.2, "east": [{"name": "gauss-markov", "std": 0.1, "time_constant": 60.0}]}.

    Raises ValueError if an argument is wrong; the message states the rule and the value.
    """
    if current is None:
        return {}
    if not isinstance(current, Mapping):
        entries = list(current) if hasattr(current, "__iter__") and not isinstance(current, str) else []
        if len(entries) != len(DIRECTIONS):
            rule = "current must be three velocities (north, east, down) [m/s] or a mapping from directions"
            raise ValueError(f"{rule}, but got {short_repr(current)}")
        current = dict(zip(DIRECTIONS, entries, strict=True))
    unknown = [direction for direction in current if direction not in DIRECTIONS]
    if unknown:
        raise ValueError(
            f"directions of current must be among {', '.join(DIRECTIONS)}, but got {short_repr(unknown)}"
        )
    signals_of = {
        direction: _signals(direction, current[direction]) for direction in DIRECTIONS if direction in current
    }
    return {direction: signals for direction, signals in signals_of.items() if signals}


def _signals(direction: str, signals_or_speed) -> tuple[Effect, ...]:
    plain = not isinstance(signals_or_speed, (Mapping, Effect, list, tuple)) and signals_or_speed is not None
    signals = CURRENT_SIGNALS.make({"name": "constant", "value": signals_or_speed} if plain else signals_or_speed)
    within(f"the current {direction}", sum(signal.largest() for signal in signals), FASTEST)
    return tuple(signal for signal in signals if signal != ConstantSignal(0.0))


# What spoils a vehicle's measurements: the effects that every plant has, and being below the surface.


VEHICLE_SENSOR_EFFECTS = Registry("sensors", SENSOR_EFFECTS.effects)


@VEHICLE_SENSOR_EFFECTS.register("near-surface")
@dataclass(frozen=True)
class NearSurface(Effect):
    """A sensor that works near the surface only, as satellites do: missing at a `depth` [m] or more."""

    depth: float = 1.0
    checks = {"depth": finite}
    loses = True

    @staticmethod
    def act(e, reading, last, t):
        """Lose a measurement at depths beyond a limit."""
        return hold_missing(reading, t.state[-1] < e.depth, last)


# Names, symbols and units of the vehicle's states and inputs.


STATES = (
    Quantity("surge velocity", "u", "m/s"),
    Quantity("sway velocity", "v", "m/s"),
    Quantity("heave velocity", "w", "m/s"),
    Quantity("roll rate", "p", "rad/s"),
    Quantity("pitch rate", "q", "rad/s"),
    Quantity("yaw rate", "r", "rad/s"),
    Quantity("roll", "phi", "rad"),  # within a right angle, as pitch is: neither wraps
    Quantity("pitch", "theta", "rad"),
    Quantity("yaw", "psi", "rad", angle=True),
    Quantity("position north", "x", "m"),
    Quantity("position east", "y", "m"),
    Quantity("depth", "z", "m"),
)
CURRENT_STATES = (Quantity("current north", "c_x", "m/s"), Quantity("current east", "c_y", "m/s"))
"""The current where a model estimates it; the vehicle's own states are the twelve above."""

SYMBOLS = tuple(state.symbol for state in STATES)

THRUST = Quantity("thrust", "X_prop", "N")
TORQUE = Quantity("propeller torque", "K_prop", "N m")
PLANES = (Quantity("stern plane", "delta_s", "rad"), Quantity("rudder", "delta_r", "rad"))
INPUTS = (THRUST, TORQUE, *PLANES)
"""Inputs of the equations of motion."""

COMMANDS = (THRUST, *PLANES)
"""Inputs of a vehicle whose propeller's torque follows from its thrust."""

ATTITUDE_INPUTS = STATES[6:8]
"""Roll and pitch where they are told from outside."""


class Instrument(NamedTuple):
    """A sensor, its noise and its rate.

    Attributes:
        channels: what it measures.
        deviation: standard deviation of its noise, in the channels' unit.
        rate: measurements per second [Hz]; None for one per step.
        source: where the numbers are from.
        at_surface: whether it measures at the surface only.
    """

    channels: tuple[str, ...]
    deviation: float
    rate: float | None
    source: str
    at_surface: bool = False


INSTRUMENTS: dict[str, Instrument] = {
    "dvl": Instrument(
        ("u", "v", "w"),
        0.02,
        5.0,
        "assumed; between HoloOcean's example (0.026 m/s at 20 Hz) and the papers' 0.001 m/s",
    ),
    "gyros": Instrument(
        ("p", "q", "r"),
        0.003,
        20.0,
        "assumed, with the vehicle's vibration; the sensor itself is better (Xsens MTi-1: 5e-4 rad/s at 20 Hz)",
    ),
    "ahrs": Instrument(("phi", "theta"), 0.005, 20.0, "Xsens MTi-300 manual MT0605P: 0.3 deg in motion"),
    "compass": Instrument(("psi",), 0.0175, 20.0, "the same manual: 1 deg in a homogeneous field"),
    "depth": Instrument(("z",), 0.02, 10.0, "assumed; a Bar30 pressure sensor resolves 2 mm"),
    "usbl": Instrument(("x", "y"), 0.5, 0.5, "assumed; small units have sub-metre to metres"),
    "gps": Instrument(
        ("x_gps", "y_gps"),
        2.0,
        1.0,
        "Xsens MTi-G-700: 2 m circular error; HoloOcean's works above 1 m depth",
        at_surface=True,
    ),
    "gravity": Instrument(
        ("g_x", "g_y", "g_z"), 0.005, 20.0, "the AHRS's angle, as a direction in the body's axes"
    ),
    "field": Instrument(("m_x", "m_y", "m_z"), 0.0175, 20.0, "the compass's, in three axes"),
    "papers": Instrument(
        ("u", "v", "w", "r"), 1e-3, None, "Ngatini, Apriliani, Nurhadi (2017), slides: R = 1e-6, every step"
    ),
}
"""Instruments by name. The errors of a real compass are slow, not white as all noise here."""

SUITES: dict[str, tuple[str, ...]] = {
    "default": ("dvl", "gyros", "ahrs", "compass", "depth"),
    "motion": ("dvl", "gyros", "ahrs"),
    "inertial": ("gyros", "ahrs", "compass", "depth"),
    "usbl": ("dvl", "gyros", "ahrs", "compass", "depth", "usbl"),
    "full": ("dvl", "gyros", "ahrs", "compass", "depth", "usbl", "gps"),
    "papers": ("papers",),
}
"""Suites of instruments by name: "default" for navigation, "motion" for what eight states predict, ..."""

VECTORS = (*INSTRUMENTS["gravity"].channels, *INSTRUMENTS["field"].channels)
ROTATING_SUITES = {**SUITES, "vectors": ("dvl", "gyros", "gravity", "field", "depth")}
"""Those of a vehicle whose attitude is a quaternion: "vectors" measures directions, which no attitude spoils."""


def _of_state(symbol: str, name: str | None = None) -> Channel:
    """The channel that measures one state, or a second channel of it with another name."""
    i = SYMBOLS.index(symbol)
    _, _, unit, angle = STATES[i]
    name = symbol if name is None else name
    deviation = next(instrument.deviation for instrument in INSTRUMENTS.values() if name in instrument.channels)
    return Channel(
        Quantity(f"measured {STATES[i].name}" + (" (satellites)" if name != symbol else ""), name, unit, angle),
        deviation**2,
        written_out("read", "x, y, u, c", f"x[{i}]"),
        written_out("slopes", "x, dy, c", unit_row(i, len(STATES))),
    )


def unit_row(index: int, count: int) -> str:
    """Source of row `index` of the identity matrix of size `count`."""
    return tuple_of("1.0" if i == index else "0.0" for i in range(count))


CHANNELS: dict[str, Channel] = {
    **{symbol: _of_state(symbol) for symbol in SYMBOLS},
    "x_gps": _of_state("x", "x_gps"),
    "y_gps": _of_state("y", "y_gps"),
}
"""Channels by name, of a plant of twelve states."""

MEASURED = {name: name.removesuffix("_gps") for name in CHANNELS}
"""The state that each channel measures."""


# A vehicle whose attitude is a quaternion: states (nu, quaternion, x, y, z), and channels that read them.


ATTITUDES = EULER, QUATERNION = "euler", "quaternion"
ROTATING_STATES = (*STATES[:6], Rotation("attitude"), *STATES[9:])
DIP = math.radians(-32.0)  # of the magnetic field, which points up south of the magnetic equator; assumed
FIELD = (math.cos(DIP), 0.0, math.sin(DIP))
DOWN = (0.0, 0.0, 1.0)


@makes_functions
def _rotating_reading(index: int) -> Callable:
    def read(x, y, u, c):
        return x[index]

    return read


@makes_functions
def _angle_reading(index: int) -> Callable:
    def read(x, y, u, c):
        return angled_state(x)[index]

    return read


@makes_functions
def _direction_reading(direction: tuple[float, float, float], axis: int) -> Callable:
    def read(x, y, u, c):
        return rotations.to_body(x[6:10], direction)[axis]

    return read


def _rotating_channels() -> dict[str, Channel]:
    result = {}
    for name, channel in CHANNELS.items():
        index = SYMBOLS.index(MEASURED[name])
        is_angle = 6 <= index < 9
        read = _angle_reading(index) if is_angle else _rotating_reading(index + (index >= 9))
        quantity = channel.quantity._replace(angle=is_angle and name != "theta")
        result[name] = Channel(quantity, channel.variance, read)
    for symbol, what, direction in (("g", "gravity", DOWN), ("m", "the magnetic field", FIELD)):
        for axis, letter in enumerate("xyz"):
            name = f"{symbol}_{letter}"
            quantity = Quantity(f"direction of {what}, {letter}", name)
            variance = default_instrument(name).deviation ** 2
            result[name] = Channel(quantity, variance, _direction_reading(direction, axis))
    return result


@cache
def channels_of(names: tuple[str, ...], states: int) -> tuple[Channel, ...]:
    """Channels by name for a model of the first `states` states; ValueError if it lacks a measured state."""
    known = SYMBOLS[:states]
    unknown = [name for name in names if MEASURED[name] not in known]
    if unknown:
        rule = f"sensors of a model of {states} states must measure {', '.join(known)}"
        raise ValueError(f"{rule}, but got {', '.join(unknown)}")
    indices = {name: known.index(MEASURED[name]) for name in names}
    return tuple(
        CHANNELS[name]._replace(slopes=written_out("slopes", "x, dy, c", unit_row(index, states)))
        for name, index in indices.items()
    )


def suite(name: str, attitude: str = EULER) -> dict[str, Instrument]:
    """The instrument of each channel of a suite; ValueError if there is no such suite."""
    suites = SUITES if attitude == EULER else ROTATING_SUITES
    instruments = [INSTRUMENTS[instrument] for instrument in suites[one_of("sensors", name, tuple(suites))]]
    return {channel: instrument for instrument in instruments for channel in instrument.channels}


def default_instrument(channel: str) -> Instrument:
    """The instrument that measures a channel unless a suite has another."""
    return next(instrument for instrument in INSTRUMENTS.values() if channel in instrument.channels)


ROTATING_CHANNELS = _rotating_channels()
"""Channels by name, of a plant whose attitude is a quaternion."""

CHANNELS_BY_ATTITUDE = {EULER: CHANNELS, QUATERNION: ROTATING_CHANNELS}
MAX_CHANNELS = len(ROTATING_CHANNELS)

DEFAULT_DT = 0.05  # [s]; one Runge-Kutta step follows the vehicle to 2e-5 of its range
DEFAULT_MAX_THRUST = 4.0  # [N], for 1.19 m/s; with it 14 deg of stern plane, if held, pitch by 80 deg
DEFAULT_MAX_PLANE = math.radians(15.0)  # [rad]
DEFAULT_PROPELLER_TORQUE = -0.006  # K_prop over X_prop [m], assumed: K_Q/K_T D = 0.03/0.2 x 0.04 m
CRUISE_SPEED = 1.0  # [m/s], as printed for Segorogeni
# A step: diffusion of 1e-4 (m/s)^2/s in the velocities at 0.05 s, 1e-4 rad and 1e-4 m besides.
DEFAULT_PROCESS_NOISE = (5e-6,) * 6 + (1e-8,) * 6
DEFAULT_INITIAL_VARIANCES = (0.05**2,) + (0.02**2,) * 5 + (0.01**2,) * 6  # about cruise
SAMPLE_TIMES = (1e-9, 10.0)  # [s]
THRUSTS = (1e-6, 1e6)  # [N]
PLANE_RANGE = (0.0, math.radians(90.0))  # [rad]
STATES_COUNT = len(STATES)


class Plant(NamedTuple):
    """A vehicle with its noise, sampled every dt seconds; `make_plant` makes one from plain arguments."""

    parameters: VehicleParameters
    dt: float  # [s]
    max_thrust: float  # [N]
    max_plane: float  # [rad]
    propeller_torque: float | None  # K_prop over X_prop [m]; None where K_prop is an input of its own
    substeps: int  # Runge-Kutta steps a sample time
    process_noise_cov: np.ndarray  # (12, 12), a step
    measurement_noise_cov: np.ndarray  # (m, m)
    initial_mean: np.ndarray  # (12,), or (13,) with a quaternion
    initial_cov: np.ndarray  # (12, 12)
    sensors: dict[str, tuple[Effect, ...]]  # effects by channel; the m channels in their order
    instruments: dict[str, Instrument]  # by channel
    current: Current = {}  # signals by direction
    propeller_lag: float = 0.0  # time constant from the commanded thrust to the propeller's [s]
    plane_lag: float = 0.0  # and of both planes [s]
    attitude: str = EULER  # or "quaternion"

    @property
    def constants(self) -> Constants:
        """Constants of the equations of motion, for one Runge-Kutta step."""
        return derive_constants(self.parameters, self.dt / self.substeps, self.propeller_torque or 0.0)

    @property
    def inputs(self) -> tuple[Quantity, ...]:
        """Thrust, the propeller's torque where it is an input, stern plane and rudder."""
        return INPUTS if self.propeller_torque is None else COMMANDS

    @property
    def max_torque(self) -> float:
        """Torques are clipped to plus and minus this, where they are an input [N m]."""
        return abs(DEFAULT_PROPELLER_TORQUE) * self.max_thrust

    @property
    def input_limits(self) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest inputs (p,), in their order, at which inputs are clipped."""
        torque = [] if self.propeller_torque is not None else [self.max_torque]
        high = np.array([self.max_thrust, *torque, self.max_plane, self.max_plane])
        return np.concatenate([[0.0], -high[1:]]), high

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the measured quantities, in order."""
        return tuple(self.sensors)

    @property
    def dropping_channels(self) -> tuple[int, ...]:
        """Numbers of the channels whose measurements may be missing."""
        return dropping_channels(self.sensors)


def rotating_state(x):
    """(nu, quaternion, ...) of a state (nu, phi, theta, psi, ...): turned by yaw, then pitch, then roll."""
    c_phi, s_phi, c_theta, s_theta = attitude_of(0.5 * x[6], 0.5 * x[7])
    c_psi, s_psi = cosine_and_sine(0.5 * x[8])
    rolled = rotations.product((c_theta, 0.0, s_theta, 0.0), (c_phi, s_phi, 0.0, 0.0))
    return (*x[:6], *rotations.product((c_psi, 0.0, 0.0, s_psi), rolled), *x[9:])


def make_plant(
    preset: str | Mapping | VehicleParameters = "segorogeni",
    dt: float = DEFAULT_DT,
    max_thrust: float = DEFAULT_MAX_THRUST,
    max_plane: float = DEFAULT_MAX_PLANE,
    propeller_torque: float | None = DEFAULT_PROPELLER_TORQUE,
    process_noise_cov=DEFAULT_PROCESS_NOISE,
    measurement_noise_cov=None,
    initial_state=None,
    sensors=None,
    current=None,
    propeller_lag: float = 0.0,
    plane_lag: float = 0.0,
    substeps: int | None = None,
    attitude: str = EULER,
) -> Plant:
    """Make a plant from plain arguments, the same ones that the env takes.

    Args:
        preset: a preset's name, a mapping of the fields of `VehicleParameters`, or one of these.
        dt: sample time [s]. Covariances are per step and do not scale with dt.
        max_thrust: thrusts are clipped to 0 and this [N].
        max_plane: angles of both planes are clipped to plus and minus this [rad].
        propeller_torque: the propeller's torque over its thrust [m]; None makes the torque an input.
        process_noise_cov: Q, covariance (12, 12) or twelve variances per step; zero allowed.
        measurement_noise_cov: R, covariance (m, m) or m variances; zero allowed. None for those of the sensors.
        initial_state: None for about a cruise at 1 m/s, a fixed state (12,), or a mapping: {"speed": U} for a
            fixed speed straight ahead from the origin, 0 for rest, or {"mean": [..], "cov": [..]}.
        sensors: None for the suite "default", the name of a suite of `SUITES`, a list of channels of
            `channels.CHANNELS`, or a mapping from channels to lists of effects. Suites and lists come at the rates
            of their instruments, satellites near the surface; in a mapping, effects "sample-every" and
            "near-surface" say so.
        current: three velocities (north, east, down) [m/s], or signals by direction; see `auv.effects`.
        propeller_lag: time constant with which the thrust follows the command [s]; 0 for at once. (A small
            propeller's is some 1 s.)
        plane_lag: that of both planes [s]. (Servos have some 0.1 s.) Filters model neither lag.
        substeps: Runge-Kutta steps per sample time; None for the fewest that reach `operating.ONE_STEP_ACCURACY`.
        attitude: of the state, "euler" for roll, pitch and yaw, which end at a pitch of 90 deg, or "quaternion",
            with which the vehicle may loop: the state has 13 numbers, and the covariances are of its error, three
            angles about the body's axes in the place of roll, pitch and yaw. `initial_state` has twelve numbers as
            before.

    Raises:
        ValueError: if an argument is wrong; the message states the rule and the value.
    """
    parameters, attitude = preset_parameters(preset), one_of("attitude", attitude, ATTITUDES)
    dt = between("dt", positive("dt", dt), *SAMPLE_TIMES, "s")
    max_thrust = between("max_thrust", positive("max_thrust", max_thrust), *THRUSTS, "N")
    max_plane = between("max_plane", max_plane, *PLANE_RANGE, "rad")
    if propeller_torque is not None:
        propeller_torque = finite("propeller_torque", propeller_torque)
    at_speed = np.eye(STATES_COUNT)[0]
    mean, cov = initial_distribution(
        initial_state,
        (CRUISE_SPEED * at_speed, np.diag(DEFAULT_INITIAL_VARIANCES)),
        *("twelve", "speed", "U"),
        lambda speed: positive("the speed of initial_state", speed, zero_allowed=True) * at_speed,
    )
    effects, instruments = _sensors(sensors, dt, attitude)
    if attitude == QUATERNION:
        mean = np.array(rotating_state(tuple(mean.tolist())))
    if measurement_noise_cov is None:
        measurement_noise_cov = [instrument.deviation**2 for instrument in instruments.values()]
    if substeps is None:
        substeps = required_substeps(parameters, dt, max_thrust, max_plane)
    return Plant(
        parameters,
        dt,
        max_thrust,
        max_plane,
        propeller_torque,
        at_least("substeps", substeps, 1, 10_000),
        checked_noise("process_noise_cov", process_noise_cov, STATES_COUNT),
        checked_noise("measurement_noise_cov", measurement_noise_cov, len(effects)),
        mean,
        cov,
        effects,
        instruments,
        make_current(current),
        positive("propeller_lag", propeller_lag, zero_allowed=True),
        positive("plane_lag", plane_lag, zero_allowed=True),
        attitude,
    )


def _sensors(sensors, dt: float, attitude: str) -> tuple[dict[str, tuple[Effect, ...]], dict[str, Instrument]]:
    """Effects and instrument of each channel."""
    if sensors is None or isinstance(sensors, str):
        instruments = suite("default" if sensors is None else sensors, attitude)
        return {channel: _timing(instrument, dt) for channel, instrument in instruments.items()}, instruments
    if not isinstance(sensors, Mapping):
        if not hasattr(sensors, "__iter__"):
            rule = "sensors must be a suite's name, a list of channels or a mapping from them"
            raise ValueError(f"{rule}, but got {short_repr(sensors)}")
        names = list(sensors)
        known = [one_of("a channel of sensors", name, tuple(CHANNELS_BY_ATTITUDE[attitude])) for name in names]
        sensors = {name: _timing(default_instrument(name), dt) for name in known}
        if len(sensors) != len(names):
            raise ValueError(f"sensors must name each channel once, but got {short_repr(names)}")
    effects = sensor_effects(sensors, CHANNELS_BY_ATTITUDE[attitude], VEHICLE_SENSOR_EFFECTS, MAX_CHANNELS)
    return effects, {channel: default_instrument(channel) for channel in effects}


def _timing(instrument: Instrument, dt: float) -> tuple[Effect, ...]:
    """Effects for the rate of an instrument, in whole steps, and for the depth at which it works."""
    steps = 1 if instrument.rate is None else max(1, round(1.0 / (instrument.rate * dt)))
    return (SampleEvery(steps),) * (steps > 1) + (NearSurface(),) * instrument.at_surface


# A vehicle as data for JSON, for files that record their plant.


ESSENTIAL = "preset", "parameters", "dt", "sensors", "propeller_torque", "attitude"
BOUNDS_AND_NOISE = "max_thrust", "max_plane", "process_noise_cov", "measurement_noise_cov"
DISTURBANCES = "sensor_effects", "current", "propeller_lag", "plane_lag"
ENTRIES = Entries(ESSENTIAL, (*ESSENTIAL, *BOUNDS_AND_NOISE, *DISTURBANCES), VehicleParameters._fields)


def plant_data(plant: Plant) -> dict:
    """The data on which a filter's parameters depend, see `thruster_env.env.plant_data.data_of`."""
    return data_of(plant, ENTRIES, PRESETS)


def check_same_plant(tuned_for: Mapping, plant: Plant, file: str | Path) -> list[str]:
    """Raise ValueError, with the differences, if a tuned file is for another plant; return other differences.

    Args:
        tuned_for: the file's data of a plant, from `plant_data`.
        plant: where it is to be used.
        file: its path.
    """
    return check_same(ENTRIES, {"attitude": EULER, **tuned_for}, plant_data(plant), file)  # older files have none
