"""What the effects on a thruster need to know of it."""

from __future__ import annotations

from dataclasses import dataclass

from plants.disturbances.effects import Context


@dataclass(frozen=True)
class ThrusterContext(Context):
    """What an effect on a thruster may need to turn its arguments into numbers."""

    thrust_scale: float  # steady thrust at max_voltage [N]
    back_emf: float  # motor speed to back-EMF, K1/K2 [V s/rad]
