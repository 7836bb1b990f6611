"""The context of effects on a thruster."""

from __future__ import annotations

from dataclasses import dataclass

from thruster_env.effects.effects import Context


@dataclass(frozen=True)
class ThrusterContext(Context):
    """The data with which an effect on a thruster computes its parameters."""

    thrust_scale: float  # steady thrust at max_voltage [N]
    back_emf: float  # motor speed to back-EMF, K1/K2 [V s/rad]
