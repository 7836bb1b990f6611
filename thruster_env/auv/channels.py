"""Sensors of a vehicle: channels, instruments with their noise and rate, and suites of instruments.

Each channel is one of the states; x and y have two, for a position by sound and by satellites.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

from thruster_env.core.checks import one_of
from thruster_env.core.sources import tuple_of, written_out
from thruster_env.env.copies import Channel
from thruster_env.model.quantities import Quantity

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


def _of_state(symbol: str, code: int, name: str | None = None) -> Channel:
    """The channel that measures one state, or a second channel of it with another name."""
    i = SYMBOLS.index(symbol)
    _, _, unit, angle = STATES[i]
    name = symbol if name is None else name
    deviation = next(instrument.deviation for instrument in INSTRUMENTS.values() if name in instrument.channels)
    return Channel(
        Quantity(f"measured {STATES[i].name}" + (" (satellites)" if name != symbol else ""), name, unit, angle),
        deviation**2,
        code,
        written_out("read", "x, y, u, c", f"x[{i}]"),
        written_out("slopes", "x, dy, c", unit_row(i, len(STATES))),
    )


def unit_row(index: int, count: int) -> str:
    """Source of row `index` of the identity matrix of size `count`."""
    return tuple_of("1.0" if i == index else "0.0" for i in range(count))


CHANNELS: dict[str, Channel] = {
    **{symbol: _of_state(symbol, code) for code, symbol in enumerate(SYMBOLS)},
    "x_gps": _of_state("x", 12, "x_gps"),
    "y_gps": _of_state("y", 13, "y_gps"),
}
"""Channels by name, of a plant of twelve states."""

MAX_CHANNELS = len(CHANNELS)

MEASURED = {name: name.removesuffix("_gps") for name in CHANNELS}
"""The state that each channel measures."""


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


def suite(name: str) -> dict[str, Instrument]:
    """The instrument of each channel of a suite; ValueError if there is no such suite."""
    instruments = [INSTRUMENTS[instrument] for instrument in SUITES[one_of("sensors", name, tuple(SUITES))]]
    return {channel: instrument for instrument in instruments for channel in instrument.channels}


def default_instrument(channel: str) -> Instrument:
    """The instrument that measures a channel unless a suite has another."""
    return next(instrument for instrument in INSTRUMENTS.values() if channel in instrument.channels)
