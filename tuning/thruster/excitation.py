"""Excitations: voltages that stir a thruster so that a filter has something to tell, drawn anew for every seed.

An excitation is a frozen dataclass of plain numbers, registered by name. Its `voltages` are a function of the
plant and of the episodes' keys alone, so that all filters meet the same ones.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from numerics.checks import at_least, finite, positive, vector
from numerics.streams import EXCITATION, uniform_block
from plants.disturbances.effects import LONGEST, Effect, Registry, set_field
from plants.disturbances.sensors import probability
from thruster_env.control.controllers import PIController
from thruster_env.control.gains import lambda_gains
from thruster_env.effects.reference import REFERENCE_SIGNALS
from thruster_env.engine.copies import Copies
from thruster_env.engine.memory import NEXT_REFERENCE, READINGS
from thruster_env.linear.operating import operating_points
from thruster_env.plant import Plant
from thruster_env.task import Task

EXCITATIONS = Registry("excitation")


class Excitation(Effect):
    """Base of all excitations; fields of the dataclass are the arguments."""

    def voltages(self, plant: Plant, keys: np.ndarray, steps: int) -> np.ndarray:
        """Voltages (B, steps) [V] for keys (B, 2); those beyond the plant's range are to be cut off."""
        raise TypeError(f"{type(self).__name__} has no voltages: use one of its subclasses")


@EXCITATIONS.register("steps")
@dataclass(frozen=True)
class Steps(Excitation):
    """Levels uniform within plus and minus `amplitude` [V], each held for `hold` steps."""

    amplitude: float = 12.0
    hold: int = 25

    def __post_init__(self):
        """Check the arguments."""
        set_field(self, "amplitude", positive("amplitude", self.amplitude, zero_allowed=True))
        set_field(self, "hold", at_least("hold", self.hold, 1, LONGEST))

    def voltages(self, plant: Plant, keys: np.ndarray, steps: int) -> np.ndarray:
        """Voltages (B, steps) [V]."""
        return held_levels(keys, self.amplitude, self.hold, steps)


@EXCITATIONS.register("prbs")
@dataclass(frozen=True)
class BinarySequence(Steps):
    """Pseudo-random binary sequence: plus or minus `amplitude` [V] with equal chance, drawn every `hold` steps."""

    def voltages(self, plant: Plant, keys: np.ndarray, steps: int) -> np.ndarray:
        """Voltages (B, steps) [V]."""
        return self.amplitude * np.sign(held_levels(keys, 1.0, self.hold, steps))


@EXCITATIONS.register("multi-sine")
@dataclass(frozen=True)
class MultiSine(Excitation):
    """Sines of equal `amplitude` [V], given `periods` [s] and drawn phases, added to `offset` [V]."""

    amplitude: float = 4.0
    offset: float = 0.0
    periods: tuple[float, ...] = (2.3, 0.9, 0.4)

    def __post_init__(self):
        """Check the arguments."""
        set_field(self, "amplitude", positive("amplitude", self.amplitude, zero_allowed=True))
        set_field(self, "offset", finite("offset", self.offset))
        periods = tuple(positive("periods", period) for period in vector("periods", self.periods).tolist())
        set_field(self, "periods", periods)

    def voltages(self, plant: Plant, keys: np.ndarray, steps: int) -> np.ndarray:
        """Voltages (B, steps) [V]."""
        turns = plant.dt * np.arange(steps)[:, None] / np.array(self.periods)  # (steps, sines)
        phases, *_ = _uniforms(keys, np.arange(len(self.periods)))
        sines = np.sin(2.0 * math.pi * (turns[None] + phases[:, None, :]))
        return self.offset + self.amplitude * sines.sum(axis=2)


@EXCITATIONS.register("dwells")
@dataclass(frozen=True)
class Dwells(Excitation):
    """Slow crossings of zero and dwells there.

    Straight lines of `ramp` steps lead from level to level, where the voltage stays for `dwell` steps. A level is
    zero with probability `zeros`, else uniform within plus and minus `amplitude` [V].
    """

    amplitude: float = 1.0
    ramp: int = 50
    dwell: int = 25
    zeros: float = 0.5

    def __post_init__(self):
        """Check the arguments."""
        set_field(self, "amplitude", positive("amplitude", self.amplitude, zero_allowed=True))
        set_field(self, "ramp", at_least("ramp", self.ramp, 1, LONGEST))
        set_field(self, "dwell", at_least("dwell", self.dwell, 0, LONGEST))
        set_field(self, "zeros", probability("zeros", self.zeros))

    def voltages(self, plant: Plant, keys: np.ndarray, steps: int) -> np.ndarray:
        """Voltages (B, steps) [V]."""
        part, place = np.divmod(np.arange(steps), self.ramp + self.dwell)
        share, place, *_ = _uniforms(keys, np.arange(part[-1] + 2)), np.maximum(place - self.dwell, 0) / self.ramp
        chance, level, *_ = share
        levels = np.where(chance < self.zeros, 0.0, self.amplitude * (2.0 * level - 1.0))
        return levels[:, part] + place * (levels[:, part + 1] - levels[:, part])


@EXCITATIONS.register("pi")
@dataclass(frozen=True)
class ClosedLoop(Excitation):
    """The voltage of a PI controller that makes the measured thrust follow a reference.

    The loop is that of `BowThrusterTracking-v0` with the same seed and reference under `PIController.for_env`. It
    is closed through the sensor and all that spoils it, not through a filter: all filters meet the same voltages.

    Args:
        low: lowest level of the reference, as a fraction of the steady thrust at max_voltage.
        high: highest level.
        hold_time: for which a level is held [s].
    """

    low: float = -0.5
    high: float = 0.5
    hold_time: float = 0.5

    def __post_init__(self):
        """Check the arguments."""
        for name, value in self.reference[0].as_mapping().items():
            if name != "name":
                set_field(self, name, value)

    @property
    def reference(self) -> tuple[Effect, ...]:
        """The reference's one signal."""
        levels = {"low": self.low, "high": self.high, "hold_time": self.hold_time}
        return REFERENCE_SIGNALS.make({"name": "steps", **levels})

    def voltages(self, plant: Plant, keys: np.ndarray, steps: int) -> np.ndarray:
        """Voltages (B, steps) [V]; ValueError if the plant does not measure its thrust."""
        if "thrust" not in plant.channels:
            raise ValueError(f"a closed loop must measure the thrust, but got {', '.join(plant.channels)}")
        controller = PIController(
            plant, operating_points(plant), *lambda_gains(plant), plant.channels.index("thrust")
        )
        copies = Copies(plant, Task(self.reference), len(keys))
        out, state, report = np.empty((len(keys), steps)), None, copies.begin(keys)
        measured = slice(READINGS, READINGS + len(plant.channels))
        for k in range(steps):
            # An env's observation, and so in float32.
            observation = np.concatenate([report[measured], report[[NEXT_REFERENCE]]]).T.astype(np.float32)
            action, state = controller.predict(observation, state)
            out[:, k] = action[:, 0]
            report = copies.step(out[:, k])
        return out


def held_levels(keys: np.ndarray, amplitude: float, hold: int, steps: int) -> np.ndarray:
    """Voltages (B, steps) [V]: levels uniform within plus and minus amplitude, each held for `hold` steps."""
    u, *_ = _uniforms(keys, np.arange(steps) // hold)
    return amplitude * (2.0 * u - 1.0)


def _uniforms(keys: np.ndarray, numbers: np.ndarray) -> tuple[np.ndarray, ...]:
    """Four uniform numbers in (0, 1), each (B, K), for keys (B, 2) and numbers (K,) of what is drawn."""
    return uniform_block(0, numbers[None, :], EXCITATION, keys[:, :1], keys[:, 1:])
