"""Thruster parameters with units and sources, checked at construction, and the presets by name."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from thruster_env.checks import finite, one_of, positive, within
from thruster_env.dynamics import Constants

ANGLES = ("as-printed", "rotor-plane", "shaft-axis")


class ThrusterParameters(NamedTuple):
    """The parameters of Healey's two-state thruster model.

    `angles` says how the attack angle alpha and the direction theta of the thrust axis follow from the
    inflow angle phi = arctan2(U_a, U_p) and the blade angle p:

    - "as-printed": alpha = (pi/2 - p) - phi, theta = p - alpha. The pair of the papers; its force components
      are axial and tangential only for p = pi/4.
    - "rotor-plane": alpha = p - phi, theta = phi.
    - "shaft-axis": alpha = (pi/2 - p) - phi, theta = phi.

    `force_asymmetry` e is ours: all forces are multiplied by 1 + e cos(phi), so by 1 + e forward and by 1 - e
    in reverse. The papers' thruster is symmetric.
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
    force_asymmetry: float = 0.0  # e [-]


def checked(parameters: ThrusterParameters) -> ThrusterParameters:
    """Return the parameters as floats; raise ValueError that names the rule and the value if one is off."""
    values = {}
    for name, value in parameters._asdict().items():
        if name == "angles":
            values[name] = one_of("angles", value, ANGLES)
        elif name in ("drag_coefficient", "load_gain", "momentum_drag"):
            values[name] = positive(name, value, zero_allowed=True)
        elif name == "blade_angle":
            values[name] = finite(name, value)
        elif name == "force_asymmetry":
            values[name] = within(name, value, 0.9)
        else:
            values[name] = positive(name, value)
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
"""The tunnel with K_h = 17 790 (the print's dot is a thousands separator), A = pi D^2/4 (which gives the
printed K3 and K4) and the rotor-plane angles, the one pair whose bollard K_T (0.22) is a real thruster's."""

OPEN_BLADED_CORRECTED = OPEN_BLADED._replace(voltage_gain=650.0, area=math.pi * 0.15**2 / 4)
"""The open-bladed table with A = pi D^2/4 and K2 = 650 (an inference: V_s was in millivolts). Corrected, but
not physical: its bollard K_T of 2.1 is about five times that of any measured thruster."""

PRESETS: dict[str, ThrusterParameters] = {
    "tunnel": TUNNEL,
    "open_bladed": OPEN_BLADED,
    "tunnel_physical": TUNNEL_PHYSICAL,
    "open_bladed_corrected": OPEN_BLADED_CORRECTED,
}


def preset_parameters(preset: str | Mapping | ThrusterParameters) -> ThrusterParameters:
    """Parameters from a preset's name, a mapping of all fields, or parameters; ValueError otherwise."""
    if isinstance(preset, ThrusterParameters):
        return checked(preset)
    if isinstance(preset, Mapping):
        try:
            return checked(ThrusterParameters(**preset))
        except TypeError as error:
            names = ", ".join(ThrusterParameters._fields)
            raise ValueError(f"a preset mapping must have the fields {names}: {error}") from None
    return PRESETS[one_of("preset", preset, tuple(PRESETS))]


def derive_constants(p: ThrusterParameters, ambient_velocity: float = 0.0, substep: float = 0.0) -> Constants:
    """Constants of the equations of motion for parameters, a flow U_0 [m/s] and a time step [s]."""
    attack = p.blade_angle if p.angles == "rotor-plane" else math.pi / 2 - p.blade_angle  # at zero inflow
    turn = 2 * p.blade_angle - math.pi / 2 if p.angles == "as-printed" else 0.0  # theta - phi
    arm = 0.7 * p.diameter / 2
    pressure = 0.5 * p.density * p.area  # over V^2
    # Polynomials in (U_p, U_a), as factors of U_p^2, U_p U_a, U_a^2 or of U_p, U_a.
    sine = np.array([math.sin(2 * attack), -2 * math.cos(2 * attack), -math.sin(2 * attack)])  # V^2 sin(2 alpha)
    cosine = np.array([math.cos(2 * attack), 2 * math.sin(2 * attack), -math.cos(2 * attack)])
    lift = pressure * p.lift_coefficient * sine
    drag = pressure * p.drag_coefficient * (np.array([1.0, 0.0, 1.0]) - cosine)
    along = np.array([math.cos(turn), -math.sin(turn)])  # V cos(theta)
    across = np.array([math.sin(turn), math.cos(turn)])  # V sin(theta)
    blade_speed = arm / p.gear_ratio
    powers = blade_speed ** np.array([3, 2, 1, 0])  # from U_p to omega_m
    thrust = (np.convolve(lift, along) - np.convolve(drag, across)) * powers
    torque = (np.convolve(lift, across) + np.convolve(drag, along)) * powers * arm
    return Constants(
        p.motor_damping,
        p.voltage_gain,
        p.load_gain,
        1.0 / p.added_mass,
        p.momentum_drag / p.added_mass,
        blade_speed,
        p.force_asymmetry,
        *thrust.tolist(),
        *torque.tolist(),
        ambient_velocity=float(ambient_velocity),
        substep=float(substep),
    )
