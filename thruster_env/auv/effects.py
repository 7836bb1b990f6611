"""Disturbances of the vehicle: currents and sensor effects.

Forces on the vehicle are those of its velocity through the water; its state is the velocity over ground. A filter
whose model has no current takes it for a disturbance.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from thruster_env.core.checks import finite, short_repr, within
from thruster_env.core.compiled import inlined
from thruster_env.effects.effects import Context, Effect, Registry
from thruster_env.effects.sensors import SENSOR_EFFECTS, hold_missing
from thruster_env.effects.signals import ConstantSignal, GaussMarkov, Gusts, RecordedSignal, Sinusoid

# The current that a vehicle goes in: signals to the north, to the east and down [m/s], the same everywhere.


DIRECTIONS = ("north", "east", "down")
FASTEST = 100.0  # [m/s]: beyond it there is no water
CURRENT_SIGNALS = Registry(
    "current",
    {
        "constant": ConstantSignal,
        "gauss-markov": GaussMarkov,
        "sinusoid": Sinusoid,
        "gusts": Gusts,
        "recorded": RecordedSignal,
    },
)

Current = dict[str, tuple[Effect, ...]]


def make_current(current) -> Current:
    """Signals by direction, from None, three numbers (north, east, down) [m/s] or a mapping from directions.

    Each entry of a mapping is a number or a list of signals of CURRENT_SIGNALS, which are added:
    {"north": 0.2, "east": [{"name": "gauss-markov", "std": 0.1, "time_constant": 60.0}]}.

    Raises ValueError if an argument is wrong; the message states the rule and the value.
    """
    if current is None:
        return {}
    if not isinstance(current, Mapping):
        entries = list(current) if hasattr(current, "__iter__") and not isinstance(current, str) else []
        if len(entries) != len(DIRECTIONS):
            rule = "current must be three velocities (north, east, down) [m/s] or a mapping from directions"
            raise ValueError(f"{rule}, but got {short_repr(current)}")
        current = dict(zip(DIRECTIONS, entries, strict=True))
    unknown = [direction for direction in current if direction not in DIRECTIONS]
    if unknown:
        raise ValueError(
            f"directions of current must be among {', '.join(DIRECTIONS)}, but got {short_repr(unknown)}"
        )
    signals_of = {
        direction: _signals(direction, current[direction]) for direction in DIRECTIONS if direction in current
    }
    return {direction: signals for direction, signals in signals_of.items() if signals}


def _signals(direction: str, signals_or_speed) -> tuple[Effect, ...]:
    plain = not isinstance(signals_or_speed, (Mapping, Effect, list, tuple)) and signals_or_speed is not None
    signals = CURRENT_SIGNALS.make({"name": "constant", "value": signals_or_speed} if plain else signals_or_speed)
    within(f"the current {direction}", sum(signal.largest() for signal in signals), FASTEST)
    return tuple(signal for signal in signals if signal != ConstantSignal(0.0))


# The context of effects on a vehicle.


@dataclass(frozen=True)
class VehicleContext(Context):
    """The data with which an effect on a vehicle computes its parameters."""

    depth_row: int  # of the memory: the true depth [m]


# What spoils a vehicle's measurements: the effects that every plant has, and being below the surface.


VEHICLE_SENSOR_EFFECTS = Registry("sensors", SENSOR_EFFECTS.effects)


@VEHICLE_SENSOR_EFFECTS.register("near-surface")
@dataclass(frozen=True)
class NearSurface(Effect):
    """A sensor that works near the surface only, as satellites do: missing at a `depth` [m] or more."""

    depth: float = 1.0
    checks = {"depth": finite}
    row_count = 1  # the last measurement that was not missing
    loses = True

    def parameters(self, context: VehicleContext) -> list[float]:
        """The depth [m], where validity stands, the row of the true depth."""
        return [self.depth, context.valid_offset, context.depth_row]

    @staticmethod
    @inlined
    def act(memory, b, target, rows, number, numbers, at, begin):
        """Lose a measurement at depths beyond a limit."""
        limit, valid, depth = numbers[at], target + int(numbers[at + 1]), int(numbers[at + 2])
        for j in range(memory.shape[2]):
            hold_missing(memory, b, j, target, rows, valid, not memory[b, depth, j] < limit, begin)
