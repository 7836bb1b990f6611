"""Names, symbols and units of the vehicle's states and inputs."""

from __future__ import annotations

from thruster_env.model.quantities import Quantity

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

CURRENT_INPUTS = (*CURRENT_STATES, Quantity("current down", "c_z", "m/s"))
