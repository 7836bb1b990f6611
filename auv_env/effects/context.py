"""What the effects on a vehicle need to know of it."""

from __future__ import annotations

from dataclasses import dataclass

from plants.disturbances.effects import Context


@dataclass(frozen=True)
class VehicleContext(Context):
    """What an effect on a vehicle may need to turn its arguments into numbers."""

    depth_row: int  # of the memory: the true depth [m]
