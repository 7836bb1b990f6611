"""What spoils a vehicle's measurements: the effects that every plant has, and being below the surface."""

from __future__ import annotations

from dataclasses import dataclass

from thruster_env.auv.effects.context import VehicleContext
from thruster_env.core.checks import finite
from thruster_env.core.compiled import inlined
from thruster_env.effects.effects import Effect, Registry, set_field
from thruster_env.effects.missing import hold_missing
from thruster_env.effects.sensors import SENSOR_EFFECTS

VEHICLE_SENSOR_EFFECTS = Registry("sensors")
for _name, _effect in SENSOR_EFFECTS.effects.items():
    VEHICLE_SENSOR_EFFECTS.register(_name)(_effect)


@inlined
def near_surface(memory, b, target, rows, number, numbers, at, begin):
    """Lose a measurement at depths beyond a limit."""
    limit, valid, depth = numbers[at], target + int(numbers[at + 1]), int(numbers[at + 2])
    for j in range(memory.shape[2]):
        hold_missing(memory, b, j, target, rows, valid, not memory[b, depth, j] < limit, begin)


@VEHICLE_SENSOR_EFFECTS.register("near-surface")
@dataclass(frozen=True)
class NearSurface(Effect):
    """A sensor that works near the surface only, as satellites do: missing at a `depth` [m] or more."""

    depth: float = 1.0
    act = staticmethod(near_surface)
    loses = True

    def __post_init__(self):
        """Check the argument."""
        set_field(self, "depth", finite("depth", self.depth))

    def parameters(self, context: VehicleContext) -> list[float]:
        """The depth [m], where validity stands, the row of the true depth."""
        return [self.depth, context.valid_offset, context.depth_row]

    def rows(self, context: VehicleContext) -> int:
        """The last measurement that was there."""
        return 1
