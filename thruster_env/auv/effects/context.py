"""The context of effects on a vehicle."""

from __future__ import annotations

from dataclasses import dataclass

from thruster_env.effects.effects import Context


@dataclass(frozen=True)
class VehicleContext(Context):
    """The data with which an effect on a vehicle computes its parameters."""

    depth_row: int  # of the memory: the true depth [m]
