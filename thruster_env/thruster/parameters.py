"""Thruster parameters with units and sources, checked at construction, and the presets by name.

Preset files: an identified thruster as data, in TOML, which every command and env takes as its preset.

    [thruster]                      the fields of `ThrusterParameters`, all of them
    [dead_band]                     low and high [V]
    [recorder]                      what belongs to the recorded runs and their sensors, not to the thruster:
                                    dt, sensors, ambient_velocity, process_noise_cov (a step of dt), and by channel
                                    measurement_noise_cov, bias, lag, clock_offset
    [identified]                    how it was found, for people

An env and its model have the thruster with its dead band; `thruster_env.thruster.model.logged_model` takes the
recorder, too. Nothing in a file is run.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from thruster_env.core.checks import between, finite, meant, one_of, positive, short_repr, within
from thruster_env.core.files import as_toml, read_toml, write_whole
from thruster_env.env.copies import Channel
from thruster_env.logs.write import check_not_among
from thruster_env.model.quantities import Quantity
from thruster_env.thruster.dynamics import Constants

# Channels: quantities of a thruster that can be measured.
#
# The functions are of the state x = (omega_m, U_a), the outputs y = (T,), the input u = (V_s,) and the constants
# c of the equations of motion; the derivatives of T by the state are dy[0].


def thrust(x, y, u, c):
    """Thrust T [N]."""
    return y[0]


def thrust_slopes(x, dy, c):
    """Derivatives of the thrust [N s/rad, N s/m]."""
    return dy[0]


def speed(x, y, u, c):
    """Motor speed omega_m [rad/s]."""
    return x[0]


def speed_slopes(x, dy, c):
    """Derivatives of the speed."""
    return (1.0, 0.0)


def speed_magnitude(x, y, u, c):
    """|omega_m| [rad/s], of a tachometer without a sign."""
    return abs(x[0])


def speed_magnitude_slopes(x, dy, c):
    """Derivatives of the speed's magnitude; at rest those ahead."""
    return (1.0 if x[0] >= 0.0 else -1.0, 0.0)


def current(x, y, u, c):
    """Current of a brushed motor without friction, I = K2 (K2 V_s - K1 omega_m)/(K_h K1) [A].

    The voltage constant is K1/K2 and the inertia 1/K_h.
    """
    driving = c.voltage_gain * u[0] - c.motor_damping * x[0]
    return c.voltage_gain * driving / (c.load_gain * c.motor_damping)


MAX_CHANNELS = 4  # that a thruster may be measured by at once; a draw of noise makes four numbers

CHANNELS: dict[str, Channel] = {
    "thrust": Channel(Quantity("measured thrust", "thrust", "N"), 0.25, thrust, thrust_slopes),
    "speed": Channel(Quantity("measured speed", "speed", "rad/s"), 4.0, speed, speed_slopes),
    "speed-magnitude": Channel(
        Quantity("measured speed-magnitude", "speed-magnitude", "rad/s"),
        4.0,
        speed_magnitude,
        speed_magnitude_slopes,
        affine=False,
    ),
    "current": Channel(Quantity("measured current", "current", "A"), 0.01, current),
}
"""Channels by name; a further one may be added."""


LARGEST = 1e12  # of a parameter, and one over it the smallest positive one: floating point overflows far beyond
ANGLES = ("as-printed", "rotor-plane", "shaft-axis")


class ThrusterParameters(NamedTuple):
    """The parameters of Healey's two-state thruster model.

    `angles` says how the attack angle alpha and the direction theta of the thrust axis follow from the
    inflow angle phi = arctan2(U_a, U_p) and the blade angle p:

    - "as-printed": alpha = (pi/2 - p) - phi, theta = p - alpha. The pair of the papers; its force components
      are axial and tangential only for p = pi/4.
    - "rotor-plane": alpha = p - phi, theta = phi.
    - "shaft-axis": alpha = (pi/2 - p) - phi, theta = phi.

    `thrust_asymmetry` e is ours: the thrust is multiplied by 1 + e cos(phi), so at the bollard by 1 + e ahead and
    by 1 - e astern, the torque by nothing. The papers' thruster is symmetric.
    """

    lift_coefficient: float  # C_Lmax [-]
    drag_coefficient: float  # C_Dmax [-]
    motor_damping: float  # K1 [1/s]
    voltage_gain: float  # K2 [rad/(s^2 V)]
    load_gain: float  # K_h [1/(kg m^2)]
    added_mass: float  # K3 = rho A L gamma [kg]
    momentum_drag: float  # K4 = rho A dbeta [kg/m]
    area: float  # A [m^2]
    diameter: float  # D [m]
    gear_ratio: float  # N, motor turns for one turn of the propeller [-]
    density: float  # rho [kg/m^3]
    blade_angle: float  # p [rad]
    angles: str = "as-printed"
    thrust_asymmetry: float = 0.0  # e [-]


def checked(parameters: ThrusterParameters) -> ThrusterParameters:
    """Return the parameters as floats; raise ValueError that names the rule and the value if one is off."""
    values: dict[str, Any] = {}
    for name, value in parameters._asdict().items():
        if name == "angles":
            values[name] = one_of("angles", value, ANGLES)
        elif name in ("drag_coefficient", "load_gain", "momentum_drag"):
            values[name] = within(name, positive(name, value, zero_allowed=True), LARGEST)
        elif name == "blade_angle":
            values[name] = within(name, value, LARGEST)
        elif name == "thrust_asymmetry":
            values[name] = within(name, value, 0.9)
        else:
            values[name] = between(name, positive(name, value), 1.0 / LARGEST, LARGEST)
    return ThrusterParameters(**values)


TUNNEL = ThrusterParameters(
    lift_coefficient=1.75,
    drag_coefficient=1.2,
    motor_damping=70.15,
    voltage_gain=1133.2,
    load_gain=17.79,
    added_mass=0.954,
    momentum_drag=0.910,
    area=0.00445,
    diameter=0.0762,
    gear_ratio=2.0,
    density=998.0,
    blade_angle=math.pi / 6,
)
"""The tunnel table as printed by Nurhadi et al. (2022), its K_h and area included."""

OPEN_BLADED = ThrusterParameters(
    lift_coefficient=2.0,
    drag_coefficient=0.5,
    motor_damping=10.8,
    voltage_gain=0.65,
    load_gain=8333.0,
    added_mass=4.0,
    momentum_drag=30.0,
    area=0.00445,
    diameter=0.15,
    gear_ratio=2.0,
    density=998.0,
    blade_angle=math.pi / 4,
)
"""The open-bladed table as printed. With K2 = 0.65 in volts it hardly turns: 0.06 rad/s a volt."""

TUNNEL_PHYSICAL = TUNNEL._replace(
    load_gain=17790.0,
    area=math.pi * 0.0762**2 / 4,
    angles="rotor-plane",
)
"""The tunnel table with three corrections; everything else as printed.

- K_h = 17 790. The print's 17.790 is most likely that number with a dot as thousands separator: J = 1/K_h is then
  5.6e-5 kg m^2, the inertia of a small motor. With a thousand times more inertia, as printed, the motor would
  hardly notice the propeller's torque.
- A = pi D^2/4 = 0.00456 m^2. With this area rho A L gamma and rho A dbeta are the printed K3 and K4; with the
  printed 0.00445 m^2 they are 0.931 kg and 0.888 kg/m.
- Rotor-plane angles. Thrust and torque are the axial and tangential parts of the forces only if theta is the
  inflow angle, which the printed pair gives for p = pi/4 alone. The bollard K_T = T/(rho n^2 D^4) is 1.55 with the
  printed pair, 1.27 with the shaft-axis pair and 0.22 with this one; measured small thrusters have 0.18 to 0.46.
"""

OPEN_BLADED_CORRECTED = OPEN_BLADED._replace(voltage_gain=650.0, area=math.pi * 0.15**2 / 4)
"""The open-bladed table with two corrections; everything else as printed.

- A = pi D^2/4 = 0.01767 m^2. With this area rho A L gamma and rho A dbeta are the printed K3 and K4; with the
  printed 0.00445 m^2 they are 1.00 kg and 7.55 kg/m.
- K2 = 650. The papers used 0.65, with which a volt turns the motor at 0.06 rad/s. That their V_s is in millivolts
  is an inference.

The angles need no correction: for p = pi/4 the three pairs are one. Corrected, but not physical: the bollard K_T
of 2.1 is about five times that of any measured thruster.
"""

T200 = ThrusterParameters(
    lift_coefficient=0.3943,
    drag_coefficient=0.2062,
    motor_damping=47.68,
    voltage_gain=2386.0,
    load_gain=20000.0,
    added_mass=0.4363,
    momentum_drag=6.791,
    area=math.pi * 0.076**2 / 4,
    diameter=0.076,
    gear_ratio=1.0,
    density=998.0,
    blade_angle=math.pi / 6,
    angles="rotor-plane",
    thrust_asymmetry=0.1603,
)
"""A Blue Robotics T200, identified from its static bollard table by `tuning/plants/bollard.py`.

Source: Blue Robotics, "T200 Public Performance Data 10-20V September 2019"; 14 and 18 V held out.

Identified: C_Lmax, C_Dmax, e, K1, K2. Inferred, because a static table cannot tell:

- K_h = 1/J with J = 5e-5 kg m^2 for rotor, propeller and the water that turns along. The table fixes only ratios
  of K1, K2 and K_h, so the motor's time constant goes with J.
- K3 = rho A (L + 1.22 R) = 0.436 kg: the water in a nozzle of L = 0.05 m and at its two open ends. With these two
  the poles are at -65 and -128 1/s at full throttle ahead from 10 V, and at -82 and -171 1/s from 20 V.
- K4 = 1.5 rho A: between a duct that the jet leaves at full width (1) and an open propeller (2).
- p = pi/6, as in the tunnel. C_Lmax, C_Dmax and e hold together with this p and this K4.
- C_Dmax sets the torque, which is read off the current: a motor without friction, torque K1/K2 times current.

Asymmetry: with e = 0.160 the bollard K_T is 0.424 ahead and 0.338 astern; the table's medians are 0.429 and 0.335,
its ranges 0.40 to 0.46 and 0.31 to 0.37. The torque is not scaled by e, yet 5 % larger astern: less thrust draws
less flow, which makes the attack angle larger. By the table's current it is 2 % smaller. At one |V_s| the model
turns 1.4 % slower astern. With 13 V and an ambient flow above 3.4 m/s its jet takes more power than the shaft has.

Errors above a quarter of full speed, medians of fitted / held-out voltages: thrust from measured speed 2.2 / 2.7 %
ahead and 2.8 / 2.9 % astern; thrust from pulse width and supply 2.7 / 2.6 % ahead and 2.4 / 2.0 % astern; current
from measured speed 3.3 / 2.7 % ahead and 4.3 / 3.9 % astern. Nine rows in ten are within 10 %. At 20 V and full
throttle the model has too little thrust: 8 % ahead and 3 % astern, at the measured speed 8 and 10 %.

V_s is what reaches the motor: 8.3 V at full throttle from 10 V, 13.3 V from 20 V
(`tuning.plants.bollard` has the map from pulse width). `max_voltage` should thus be 13 V; the
thrust of 140 N at 24 V is extrapolated.
"""

PRESETS: dict[str, ThrusterParameters] = {
    "tunnel": TUNNEL,
    "open_bladed": OPEN_BLADED,
    "tunnel_physical": TUNNEL_PHYSICAL,
    "open_bladed_corrected": OPEN_BLADED_CORRECTED,
    "t200": T200,
}


LARGEST_VOLTAGE = {
    "t200": 13.3
}  # [V], that the data behind a preset reach; of the others plant.DEFAULT_MAX_VOLTAGE


def preset_parameters(preset: str | Mapping | ThrusterParameters) -> ThrusterParameters:
    """Parameters from a preset's name, a preset FILE.toml, a mapping of all fields, or parameters.

    Raises ValueError for others. See `preset_and_dead_band` for other entries of a file.
    """
    return preset_and_dead_band(preset)[0]


def preset_and_dead_band(preset) -> tuple[ThrusterParameters, tuple[float, float]]:
    """Parameters as `preset_parameters`, and the dead band (low, high) [V] that a file or a mapping may have."""
    if is_file(preset):
        return read_preset(preset)[:2]
    if isinstance(preset, Mapping) and "dead_band" in preset:
        rest = {name: value for name, value in preset.items() if name != "dead_band"}
        return _parameters(rest), checked_band(preset["dead_band"])
    return _parameters(preset), (0.0, 0.0)


def _parameters(preset: str | Mapping | ThrusterParameters) -> ThrusterParameters:
    if isinstance(preset, ThrusterParameters):
        return checked(preset)
    if isinstance(preset, Mapping):
        try:
            return checked(ThrusterParameters(**preset))
        except TypeError as error:
            names = ", ".join(ThrusterParameters._fields)
            raise ValueError(f"a preset mapping must have the fields {names}: {error}") from None
    if not isinstance(preset, str) or preset not in PRESETS:
        names = ", ".join(PRESETS)
        rule = f"preset must be one of {names}, or a file that ends in .toml"
        raise ValueError(f"{rule}, but got {short_repr(preset)}{meant(preset, PRESETS)}")
    return PRESETS[preset]


def derive_constants(p: ThrusterParameters, ambient_velocity: float = 0.0, substep: float = 0.0) -> Constants:
    """Constants of the equations of motion for parameters, a flow U_0 [m/s] and a time step [s].

    The parameters may be arrays of one shape, for many thrusters at once; so then are the constants.
    """
    attack = p.blade_angle if p.angles == "rotor-plane" else math.pi / 2 - p.blade_angle  # at zero inflow
    turn = 2 * p.blade_angle - math.pi / 2 if p.angles == "as-printed" else 0.0 * p.blade_angle  # theta - phi
    arm = 0.7 * p.diameter / 2
    pressure = 0.5 * p.density * p.area  # over V^2
    # Polynomials in (U_p, U_a), as factors of U_p^2, U_p U_a, U_a^2 or of U_p, U_a.
    lift = _scaled(
        pressure * p.lift_coefficient, (np.sin(2 * attack), -2 * np.cos(2 * attack), -np.sin(2 * attack))
    )
    drag = _scaled(
        pressure * p.drag_coefficient, (1 - np.cos(2 * attack), -2 * np.sin(2 * attack), 1 + np.cos(2 * attack))
    )
    along, across = (np.cos(turn), -np.sin(turn)), (np.sin(turn), np.cos(turn))  # V cos(theta), V sin(theta)
    blade_speed = arm / p.gear_ratio
    thrust = zip(_product(lift, along), _product(drag, across), strict=True)
    torque = zip(_product(lift, across), _product(drag, along), strict=True)
    values = (
        p.motor_damping,
        p.voltage_gain,
        p.load_gain,
        1.0 / p.added_mass,
        p.momentum_drag / p.added_mass,
        blade_speed,
        p.thrust_asymmetry,
        *((a - b) * blade_speed**power for power, (a, b) in zip((3, 2, 1, 0), thrust, strict=True)),
        *((a + b) * blade_speed**power * arm for power, (a, b) in zip((3, 2, 1, 0), torque, strict=True)),
        ambient_velocity,
        substep,
    )
    return Constants(*(value if np.ndim(value) else float(value) for value in values))


def _scaled(factor, polynomial) -> tuple:
    return tuple(factor * a for a in polynomial)


def _product(quadratic, linear) -> tuple:
    (a, b, c), (d, e) = quadratic, linear
    return a * d, a * e + b * d, b * e + c * d, c * e


STATES = (Quantity("motor speed", "omega_m", "rad/s"), Quantity("flow velocity", "U_a", "m/s"))
INPUTS = (Quantity("voltage", "V_s", "V"),)
THRUST = Quantity("thrust", "T", "N")

SECTIONS = ("thruster", "dead_band", "recorder", "identified")
BY_CHANNEL = ("measurement_noise_cov", "bias", "lag", "clock_offset")
RECORDER = ("dt", "sensors", "ambient_velocity", "process_noise_cov", *BY_CHANNEL)


class PresetFile(NamedTuple):
    """The contents of a preset file."""

    parameters: ThrusterParameters
    dead_band: tuple[float, float] = (0.0, 0.0)  # [V]
    recorder: Mapping[str, Any] = {}
    identified: Mapping[str, Any] = {}


def is_file(preset) -> bool:
    """Whether a preset is the path of a file."""
    return isinstance(preset, (str, Path)) and str(preset).endswith(".toml")


def read_preset(path: str | Path) -> PresetFile:
    """A thruster from a preset file.

    Raises:
        ValueError: if the file is wrong; the message states the rule, the value and the path.
    """
    content = read_toml(path, "a preset file")
    try:
        return _checked(content)
    except ValueError as error:
        raise ValueError(f"{error} (in {path})") from None


def _checked(content: dict) -> PresetFile:
    unknown = sorted(set(content) - set(SECTIONS))
    if unknown or not all(isinstance(part, dict) for part in content.values()):
        raise ValueError(
            f"a preset file must have the tables {', '.join(SECTIONS)}, but got {short_repr(unknown)}"
        )
    thruster, band = content.get("thruster", {}), content.get("dead_band", {})
    missing = [name for name in ThrusterParameters._fields if name not in thruster]
    unknown = [name for name in thruster if name not in ThrusterParameters._fields]
    optional = ThrusterParameters._field_defaults
    if unknown or not set(missing) <= set(optional):
        names = ", ".join(ThrusterParameters._fields)
        off = f"{unknown[0]} is none" if unknown else f"{missing[0]} is missing"
        raise ValueError(f"thruster of a preset file must have the fields {names}, but {off}")
    if sorted(band) not in ([], ["high", "low"]):
        raise ValueError(f"dead_band of a preset file must have low and high, but got {short_repr(sorted(band))}")
    for name, value in (*thruster.items(), *band.items()):
        _check_no_switch(name, value)
    recorder = content.get("recorder", {})
    _check_recorder(recorder)
    ends = checked_band((band.get("low", 0.0), band.get("high", 0.0)))
    return PresetFile(checked(ThrusterParameters(**thruster)), ends, recorder, content.get("identified", {}))


def _check_recorder(recorder: dict) -> None:
    """Raise ValueError for what is unknown or no number, whoever reads it later."""
    unknown = sorted(set(recorder) - set(RECORDER))
    if unknown:
        raise ValueError(
            f"recorder of a preset file must have {', '.join(RECORDER)}, but got {short_repr(unknown)}"
        )
    positive("dt of a preset file", recorder.get("dt", 1.0))
    finite("ambient_velocity of a preset file", recorder.get("ambient_velocity", 0.0))
    sensors = recorder.get("sensors", [])
    if not isinstance(sensors, list) or not all(isinstance(channel, str) for channel in sensors):
        raise ValueError(f"sensors of a preset file must be a list of channels, but got {short_repr(sensors)}")
    known = [one_of("a channel of sensors", channel, tuple(CHANNELS)) for channel in sensors] or list(CHANNELS)
    for name in BY_CHANNEL:
        table = recorder.get(name, {})
        if not isinstance(table, dict):
            raise ValueError(f"{name} of a preset file must be a table by channel, but got {short_repr(table)}")
        for channel, value in table.items():
            if channel not in known:
                channels = ", ".join(known)
                raise ValueError(
                    f"{name} of a preset file must be of channels {channels}, but got {short_repr(channel)}"
                )
            check = finite if name in ("bias", "clock_offset") else partial(positive, zero_allowed=True)
            check(f"{name} of {channel}", value)


def _check_no_switch(name: str, value) -> None:
    if isinstance(value, bool):  # which Python takes for a number
        raise ValueError(f"{name} must be a finite number, but got {value}")


def checked_band(ends) -> tuple[float, float]:
    """A dead band (low, high) [V]; ValueError unless low <= 0 <= high."""
    pair = tuple(ends) if isinstance(ends, (tuple, list)) else ()
    if len(pair) != 2:
        raise ValueError(f"dead_band must be two voltages, low and high, but got {short_repr(ends)}")
    low, high = (finite("dead_band", end) for end in pair)
    if not low <= 0.0 <= high:
        raise ValueError(f"dead_band must be from low <= 0 to high >= 0, but got {short_repr(pair)}")
    return low, high


def write_preset(path: str | Path, preset: PresetFile, about: str = "") -> None:
    """Write a preset file.

    Args:
        path: ends in .toml.
        preset: its contents.
        about: a line of comment.

    Raises:
        ValueError: if the path does not end in .toml, lies beside a log of its name, or cannot be written.
    """
    if not is_file(path):
        raise ValueError(f"a preset file must end in .toml, but got {str(path)!r}")
    check_not_among(path)
    low, high = preset.dead_band
    tables = {
        "thruster": preset.parameters._asdict(),
        "dead_band": {"low": low, "high": high} if (low, high) != (0.0, 0.0) else {},
        "recorder": preset.recorder,
        "identified": preset.identified,
    }
    write_whole(path, as_toml(tables, about))
