"""Excitations: inputs that move a plant through its range, drawn for every seed.

An excitation is a frozen dataclass of plain numbers, registered by name. Its inputs are a function of the
episodes' keys alone, so that all filters get the same inputs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from thruster_env.core.checks import at_least, finite, positive, vector
from thruster_env.core.streams import EXCITATION, uniform_block
from thruster_env.effects.effects import LONGEST, Effect, Registry, checked_probability, set_field

EXCITATIONS = Registry("excitation")


MOST_STEPS = int(LONGEST)  # for which a level is held


Level = float | tuple[float, ...]  # one for all inputs, or one each, in their units


class Excitation(Effect):
    """Base class of all excitations; fields of the dataclass are the arguments."""

    def inputs(self, keys: np.ndarray, steps: int, dt: float, count: int) -> np.ndarray:
        """Inputs (B, steps, count) for keys (B, 2) and a sample time [s]."""
        for name in ("amplitude", "offset", "low", "high"):
            level = getattr(self, name, 0.0)
            if isinstance(level, tuple) and len(level) != count:
                raise ValueError(f"{name} must be one number, or one for each of {count} inputs, but got {level}")
        each = [self.input(keys, steps, dt, number) for number in range(count)]
        return np.stack(each, axis=2) if each else np.zeros((len(keys), steps, 0))

    def input(self, keys: np.ndarray, steps: int, dt: float, number: int) -> np.ndarray:
        """One of the inputs, (B, steps), by its index from 0."""
        raise TypeError(f"{type(self).__name__} has no inputs: use one of its subclasses")

    def limits(self, count: int) -> tuple[np.ndarray, np.ndarray] | None:
        """Smallest and largest input, each (count,), in the inputs' units; None if unknown."""
        return None


def limits_about(offset: Any, amplitude: Any, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Plus and minus an amplitude about an offset, each (count,)."""
    middle, half = (np.array(np.broadcast_to(value, count), dtype=np.float64) for value in (offset, amplitude))
    return middle - half, middle + half


def excitation_of(excitation: Excitation | Mapping) -> Excitation:
    """An excitation as it is, or from a mapping with its name; ValueError for an unknown one."""
    (result,) = EXCITATIONS.make([excitation])
    if not isinstance(result, Excitation):
        raise TypeError(f"an excitation must be a subclass of Excitation, but got {type(result).__name__}")
    return result


@EXCITATIONS.register("steps")
@dataclass(frozen=True)
class Steps(Excitation):
    """Levels uniform within plus and minus `amplitude`, each held for `hold` steps."""

    amplitude: Level = 12.0
    hold: int = 25

    def __post_init__(self):
        """Check the arguments."""
        set_field(self, "amplitude", levels("amplitude", self.amplitude))
        set_field(self, "hold", at_least("hold", self.hold, 1, MOST_STEPS))

    def limits(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Smallest and largest input, each (count,)."""
        return limits_about(0.0, self.amplitude, count)

    def input(self, keys: np.ndarray, steps: int, dt: float, number: int) -> np.ndarray:
        """One of the inputs, (B, steps)."""
        return held_levels(keys, level_of(self.amplitude, number), self.hold, steps, number)


@EXCITATIONS.register("prbs")
@dataclass(frozen=True)
class BinarySequence(Steps):
    """Pseudo-random binary sequence: plus or minus `amplitude` with equal chance, drawn every `hold` steps."""

    def input(self, keys: np.ndarray, steps: int, dt: float, number: int) -> np.ndarray:
        """One of the inputs, (B, steps)."""
        return level_of(self.amplitude, number) * np.sign(held_levels(keys, 1.0, self.hold, steps, number))


@EXCITATIONS.register("levels")
@dataclass(frozen=True)
class Levels(Excitation):
    """Levels uniform between `low` and `high`, each held for `shortest` to `longest` steps."""

    low: Level = -12.0
    high: Level = 12.0
    shortest: int = 10
    longest: int = 50

    def __post_init__(self):
        """Check the arguments."""
        set_field(self, "low", levels("low", self.low, signed=True))
        set_field(self, "high", levels("high", self.high, signed=True))
        if np.any(np.asarray(self.low) > np.asarray(self.high)):
            raise ValueError(f"low must be at most high, {self.high}, but got {self.low}")
        set_field(self, "shortest", at_least("shortest", self.shortest, 1, MOST_STEPS))
        set_field(self, "longest", at_least("longest", self.longest, self.shortest, MOST_STEPS))

    def limits(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Smallest and largest input, each (count,)."""
        return limits_about(self.low, 0.0, count)[0], limits_about(self.high, 0.0, count)[1]

    def input(self, keys: np.ndarray, steps: int, dt: float, number: int) -> np.ndarray:
        """One of the inputs, (B, steps)."""
        share, length, *_ = uniforms(keys, np.arange(steps // self.shortest + 1), number)
        lengths = self.shortest + np.floor((self.longest - self.shortest + 1) * length).astype(np.int64)
        ends = np.cumsum(lengths, axis=1)
        piece = np.stack([np.searchsorted(run_ends, np.arange(steps), side="right") for run_ends in ends])
        low, high = level_of(self.low, number), level_of(self.high, number)
        return low + (high - low) * np.take_along_axis(share, piece, axis=1)


@EXCITATIONS.register("multi-sine")
@dataclass(frozen=True)
class MultiSine(Excitation):
    """Sines of equal `amplitude`, given `periods` [s] and drawn phases, added to `offset`."""

    amplitude: Level = 4.0
    offset: Level = 0.0
    periods: tuple[float, ...] = (2.3, 0.9, 0.4)

    def __post_init__(self):
        """Check the arguments."""
        set_field(self, "amplitude", levels("amplitude", self.amplitude))
        set_field(self, "offset", levels("offset", self.offset, signed=True))
        periods = tuple(positive("periods", period) for period in vector("periods", self.periods).tolist())
        set_field(self, "periods", periods)

    def limits(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Smallest and largest input, each (count,)."""
        return limits_about(self.offset, len(self.periods) * np.asarray(self.amplitude), count)

    def input(self, keys: np.ndarray, steps: int, dt: float, number: int) -> np.ndarray:
        """One of the inputs, (B, steps)."""
        turns = dt * np.arange(steps)[:, None] / np.array(self.periods)  # (steps, sines)
        phases, *_ = uniforms(keys, np.arange(len(self.periods)), number)
        sines = np.sin(2.0 * math.pi * (turns[None] + phases[:, None, :]))
        return level_of(self.offset, number) + level_of(self.amplitude, number) * sines.sum(axis=2)


@EXCITATIONS.register("dwells")
@dataclass(frozen=True)
class Dwells(Excitation):
    """Slow crossings of zero and dwells there.

    Straight lines of `ramp` steps lead from level to level, where the input stays for `dwell` steps. A level is
    zero with probability `zeros`, else uniform within plus and minus `amplitude`.
    """

    amplitude: Level = 1.0
    ramp: int = 50
    dwell: int = 25
    zeros: float = 0.5

    def __post_init__(self):
        """Check the arguments."""
        set_field(self, "amplitude", levels("amplitude", self.amplitude))
        set_field(self, "ramp", at_least("ramp", self.ramp, 1, MOST_STEPS))
        set_field(self, "dwell", at_least("dwell", self.dwell, 0, MOST_STEPS))
        set_field(self, "zeros", checked_probability("zeros", self.zeros))

    def limits(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Smallest and largest input, each (count,)."""
        return limits_about(0.0, self.amplitude, count)

    def input(self, keys: np.ndarray, steps: int, dt: float, number: int) -> np.ndarray:
        """One of the inputs, (B, steps)."""
        part, position = np.divmod(np.arange(steps), self.ramp + self.dwell)
        share = uniforms(keys, np.arange(part[-1] + 2), number)
        position = np.maximum(position - self.dwell, 0) / self.ramp
        chance, level, *_ = share
        amplitude = level_of(self.amplitude, number)
        amplitudes = np.where(chance < self.zeros, 0.0, amplitude * (2.0 * level - 1.0))
        return amplitudes[:, part] + position * (amplitudes[:, part + 1] - amplitudes[:, part])


def held_levels(keys: np.ndarray, amplitude: float, hold: int, steps: int, number: int = 0) -> np.ndarray:
    """Inputs (B, steps): levels uniform within plus and minus amplitude, each held for `hold` steps."""
    u, *_ = uniforms(keys, np.arange(steps) // hold, number)
    return amplitude * (2.0 * u - 1.0)


def uniforms(keys: np.ndarray, draws: np.ndarray, number: int = 0) -> tuple[np.ndarray, ...]:
    """Four uniform numbers in (0, 1), each (B, K), for keys (B, 2), the draws (K,) and the input's index."""
    return uniform_block(number, draws[None, :], EXCITATION, keys[:, :1], keys[:, 1:])


def levels(name: str, values: Any, *, signed: bool = False) -> Level:
    """One level for all inputs, or one each; ValueError unless finite and, if not signed, not negative."""
    check: Callable[[str, Any], float] = finite if signed else partial(positive, zero_allowed=True)
    return (
        tuple(check(name, value) for value in values) if isinstance(values, list | tuple) else check(name, values)
    )


def level_of(level: Level, number: int) -> float:
    """The level of one input."""
    return level[number] if isinstance(level, tuple) else level
