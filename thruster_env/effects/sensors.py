"""Sensor effects: errors of a measurement beside Gaussian noise.

A channel measures a quantity plus Gaussian noise of covariance R (`measurement_noise_cov`). A list of effects may
follow; each acts on the result of the one before. All amounts are in the channel's unit.
A missing measurement repeats the last valid one (0 before the first) and is marked as not valid.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from thruster_env.core.checks import at_least, finite, positive
from thruster_env.core.compiled import inlined
from thruster_env.core.memory import STEP
from thruster_env.effects.effects import (
    Context,
    Effect,
    Registry,
    checked_probability,
    normals,
    not_negative,
    set_field,
    uniforms,
)

SENSOR_EFFECTS = Registry("sensors")
LONGEST_INTERVAL = 1_000_000  # steps between two samples
LONGEST_DELAY = 10_000  # steps, each of which takes two numbers of every copy's memory


@inlined
def hold_missing(memory, b, j, target, last, valid, missing, begin):
    """If copy j's measurement is missing, repeat the last one, stored in row `last`, and mark it as not valid."""
    if begin:
        memory[b, last, j] = 0.0
    if missing:
        memory[b, target, j] = memory[b, last, j]
        memory[b, valid, j] = 0.0
    memory[b, last, j] = memory[b, target, j]


def _degrees(name: str, value) -> float:
    degrees = finite(name, value)
    if degrees < 1:
        raise ValueError(f"degrees must be at least 1, but got {value!r}")
    return degrees


@SENSOR_EFFECTS.register("student-t")
@dataclass(frozen=True)
class StudentT(Effect):
    """Heavy-tailed noise, scale times a Student-t variate, beside the Gaussian noise.

    Args:
        scale: of the variate, in the channel's unit.
        degrees: degrees of freedom; the variance is infinite up to 2.
    """

    scale: float
    degrees: float = 3.0
    checks = {"scale": not_negative, "degrees": _degrees}

    def parameters(self, context: Context) -> list[float]:
        """Degrees of freedom and scale."""
        return [self.degrees, self.scale]

    @staticmethod
    @inlined
    def act(memory, b, target, rows, number, numbers, at, begin):
        """Add scale times a Student-t variate: Bailey's (1994) form of the transform of Box and Muller."""
        degrees, scale = numbers[at], numbers[at + 1]
        for j in range(memory.shape[2]):
            u0, u1, _, _ = uniforms(memory, b, j, number)
            radius = (degrees * (u0 ** (-2.0 / degrees) - 1.0)) ** 0.5
            memory[b, target, j] += scale * radius * math.cos(2.0 * math.pi * u1)


@SENSOR_EFFECTS.register("outliers")
@dataclass(frozen=True)
class Outliers(Effect):
    """A mixture: with a probability, a normal variate of a (large) standard deviation comes on top."""

    std: float
    probability: float = 0.05
    checks = {"std": not_negative, "probability": checked_probability}

    def parameters(self, context: Context) -> list[float]:
        """Probability and standard deviation."""
        return [self.probability, self.std]

    @staticmethod
    @inlined
    def act(memory, b, target, rows, number, numbers, at, begin):
        """With a probability add a normal variate of a standard deviation."""
        probability, std = numbers[at], numbers[at + 1]
        for j in range(memory.shape[2]):
            u, _, _, _ = uniforms(memory, b, j, number)
            v, _, _, _ = normals(memory, b, j, number)
            if u < probability:
                memory[b, target, j] += std * v


@SENSOR_EFFECTS.register("bias")
@dataclass(frozen=True)
class Bias(Effect):
    """A bias of `value`, plus N(0, std^2) drawn once an episode, plus a random walk of `drift` a step."""

    value: float = 0.0
    std: float = 0.0
    drift: float = 0.0
    checks = {"value": finite, "std": not_negative, "drift": not_negative}
    row_count = 1  # the bias

    @staticmethod
    @inlined
    def act(memory, b, target, rows, number, numbers, at, begin):
        """Add a bias that starts at value + std n and drifts by a random walk."""
        for j in range(memory.shape[2]):
            v, _, _, _ = normals(memory, b, j, number)
            if begin:
                memory[b, rows, j] = numbers[at] + numbers[at + 1] * v
            else:
                memory[b, rows, j] += numbers[at + 2] * v
            memory[b, target, j] += memory[b, rows, j]


@SENSOR_EFFECTS.register("quantisation")
@dataclass(frozen=True)
class Quantisation(Effect):
    """Rounding to the nearest multiple of `step`."""

    step: float
    checks = {"step": positive}

    @staticmethod
    @inlined
    def act(memory, b, target, rows, number, numbers, at, begin):
        """Round to the nearest multiple of a step."""
        step = numbers[at]
        for j in range(memory.shape[2]):  # math.floor would make an integer, which ends at 2^63
            memory[b, target, j] = np.floor(memory[b, target, j] / step + 0.5) * step


@SENSOR_EFFECTS.register("saturation")
@dataclass(frozen=True)
class SensorSaturation(Effect):
    """Clipping to low ... high."""

    low: float
    high: float

    def __post_init__(self):
        """Check the arguments."""
        low, high = finite("low", self.low), finite("high", self.high)
        if not low < high:
            raise ValueError(f"low must be less than high, but got {self.low!r} and {self.high!r}")
        set_field(self, "low", low)
        set_field(self, "high", high)

    @staticmethod
    @inlined
    def act(memory, b, target, rows, number, numbers, at, begin):
        """Clip to an interval."""
        for j in range(memory.shape[2]):
            memory[b, target, j] = min(max(memory[b, target, j], numbers[at]), numbers[at + 1])


@SENSOR_EFFECTS.register("dropout")
@dataclass(frozen=True)
class Dropout(Effect):
    """Missing measurements, in runs of random length.

    The observation then repeats the last valid value (0 at first), a validity flag of the channel is appended to
    it, and `info["measurement_valid"]` holds the same flag.

    Args:
        probability: fraction of the measurements that are missing in the long run.
        mean_length: mean number of missing measurements in a row; 1/(1 - probability) is independent dropout.
    """

    probability: float = 0.1
    mean_length: float | None = None
    row_count = 2  # the last valid measurement, and whether one is missing
    loses = True

    def __post_init__(self):
        """Check the arguments."""
        share = checked_probability("probability", self.probability)
        if share == 1.0:
            raise ValueError("probability must be less than 1, but got 1.0")
        shortest = max(1.0, share / (1.0 - share))  # else a run would have to begin with a probability above 1
        length = 1.0 / (1.0 - share) if self.mean_length is None else finite("mean_length", self.mean_length)
        if length < shortest:
            raise ValueError(f"mean_length must be at least {shortest:g}, but got {self.mean_length!r}")
        set_field(self, "probability", share)
        set_field(self, "mean_length", length)

    def parameters(self, context: Context) -> list[float]:
        """Probabilities that a run of missing measurements begins and ends; offset of the validity flag."""
        assert self.mean_length is not None  # it is set when the effect is made
        begins = self.probability / (1.0 - self.probability) / self.mean_length
        return [begins, 1.0 / self.mean_length, context.valid_offset]

    @staticmethod
    @inlined
    def act(memory, b, target, rows, number, numbers, at, begin):
        """Lose measurements in runs (a two-state Markov chain); a lost one repeats the last and is not valid."""
        begins, ends, valid = numbers[at], numbers[at + 1], target + int(numbers[at + 2])
        last, lost = rows, rows + 1
        for j in range(memory.shape[2]):
            u, _, _, _ = uniforms(memory, b, j, number)
            if begin:
                memory[b, lost, j] = 0.0
            if memory[b, lost, j] > 0.0:
                memory[b, lost, j] = 0.0 if u < ends else 1.0
            else:
                memory[b, lost, j] = 1.0 if u < begins else 0.0
            hold_missing(memory, b, j, target, last, valid, memory[b, lost, j] > 0.0, begin)


def _delay_steps(name: str, value) -> int:
    steps = at_least(name, value, 1)
    if steps > LONGEST_DELAY:
        raise ValueError(f"steps must be at most {LONGEST_DELAY}, but got {value!r}")
    return steps


@SENSOR_EFFECTS.register("delay")
@dataclass(frozen=True)
class Delay(Effect):
    """A measurement that comes `steps` sample times late; at first, the first one is repeated."""

    steps: int = 1
    checks = {"steps": _delay_steps}

    def parameters(self, context: Context) -> list[float]:
        """Steps, and offset of the validity flag."""
        return [self.steps, context.valid_offset]

    def rows(self, context: Context) -> int:
        """Measurements on their way, and whether they are valid."""
        return 2 * self.steps

    @staticmethod
    @inlined
    def act(memory, b, target, rows, number, numbers, at, begin):
        """Report the measurement of `steps` steps ago, from a ring of rows; at first the first measurement."""
        steps, valid = int(numbers[at]), target + int(numbers[at + 1])
        for j in range(memory.shape[2]):
            if begin:
                for i in range(steps):
                    memory[b, rows + i, j] = memory[b, target, j]
                    memory[b, rows + steps + i, j] = memory[b, valid, j]
            slot = rows + int(memory[b, STEP, j]) % steps
            now, now_valid = memory[b, target, j], memory[b, valid, j]
            memory[b, target, j] = memory[b, slot, j]
            memory[b, valid, j] = memory[b, slot + steps, j]
            memory[b, slot, j] = now
            memory[b, slot + steps, j] = now_valid


@SENSOR_EFFECTS.register("sample-every")
@dataclass(frozen=True)
class SampleEvery(Effect):
    """A sensor slower than the plant: a sample every `steps` steps, from step number `first` on.

    Between two samples the measurement is missing, as with `Dropout`. A sensor of 5 Hz on a plant with a step of
    0.05 s has a sample every 4 steps.
    """

    steps: int
    first: int = 0
    row_count = 1  # the last sample
    loses = True

    def __post_init__(self):
        """Check the arguments."""
        steps = at_least("steps", self.steps, 1, LONGEST_INTERVAL)
        set_field(self, "steps", steps)
        set_field(self, "first", at_least("first", self.first, 0, LONGEST_INTERVAL) % steps)

    def parameters(self, context: Context) -> list[float]:
        """Steps between two samples, number of the first one, and offset of the validity flag."""
        return [self.steps, self.first, context.valid_offset]

    @staticmethod
    @inlined
    def act(memory, b, target, rows, number, numbers, at, begin):
        """Take a sample at steps first, first + steps, first + 2 steps, ...; between them the last is repeated."""
        steps, first, valid = int(numbers[at]), int(numbers[at + 1]), target + int(numbers[at + 2])
        for j in range(memory.shape[2]):
            between = (int(memory[b, STEP, j]) - first) % steps != 0
            hold_missing(memory, b, j, target, rows, valid, between, begin)
