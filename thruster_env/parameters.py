"""Thruster parameters with units and sources, checked at construction, and the presets by name."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

from thruster_env.checks import finite, one_of, positive
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
    attack_at_zero_inflow = p.blade_angle if p.angles == "rotor-plane" else math.pi / 2 - p.blade_angle
    turn = 2 * p.blade_angle - math.pi / 2 if p.angles == "as-printed" else 0.0
    arm = 0.7 * p.diameter / 2
    return Constants(
        motor_damping=p.motor_damping,
        voltage_gain=p.voltage_gain,
        load_gain=p.load_gain,
        inverse_mass=1.0 / p.added_mass,
        flow_drag=p.momentum_drag / p.added_mass,
        blade_speed=arm / p.gear_ratio,
        torque_arm=arm,
        half_lift=0.5 * p.density * p.area * p.lift_coefficient,
        half_drag=0.5 * p.density * p.area * p.drag_coefficient,
        attack_sine=math.sin(2 * attack_at_zero_inflow),
        attack_cosine=math.cos(2 * attack_at_zero_inflow),
        turn_sine=math.sin(turn),
        turn_cosine=math.cos(turn),
        ambient_velocity=float(ambient_velocity),
        substep=float(substep),
    )
