"""Names, symbols and units of the thruster's states, inputs and outputs."""

from __future__ import annotations

from thruster_env.model.quantities import Quantity

STATES = (Quantity("motor speed", "omega_m", "rad/s"), Quantity("flow velocity", "U_a", "m/s"))
INPUTS = (Quantity("voltage", "V_s", "V"),)
THRUST = Quantity("thrust", "T", "N")
