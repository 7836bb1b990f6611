"""Sensor effects: errors of a measurement beside Gaussian noise.

A channel measures a quantity plus Gaussian noise of covariance R (`measurement_noise_cov`). A list of effects may
follow; each acts on the result of the one before. All amounts are in the channel's unit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from thruster_env.core.checks import at_least, finite, positive
from thruster_env.core.compiled import inlined
from thruster_env.core.memory import STEP
from thruster_env.effects.effects import Context, Effect, Registry, normals, set_field, uniforms
from thruster_env.effects.missing import Dropout, SampleEvery, probability

SENSOR_EFFECTS = Registry("sensors")
LONGEST_DELAY = 10_000  # steps, each of which takes two numbers of every copy's memory


@inlined
def student_t(memory, b, target, rows, number, numbers, at, begin):
    """Add scale times a Student-t variate: Bailey's (1994) form of the transform of Box and Muller."""
    degrees, scale = numbers[at], numbers[at + 1]
    for j in range(memory.shape[2]):
        u0, u1, _, _ = uniforms(memory, b, j, number)
        radius = (degrees * (u0 ** (-2.0 / degrees) - 1.0)) ** 0.5
        memory[b, target, j] += scale * radius * math.cos(2.0 * math.pi * u1)


@inlined
def outliers(memory, b, target, rows, number, numbers, at, begin):
    """With a probability add a normal variate of a standard deviation."""
    probability, std = numbers[at], numbers[at + 1]
    for j in range(memory.shape[2]):
        u, _, _, _ = uniforms(memory, b, j, number)
        v, _, _, _ = normals(memory, b, j, number)
        if u < probability:
            memory[b, target, j] += std * v


@inlined
def bias(memory, b, target, rows, number, numbers, at, begin):
    """Add a bias that starts at value + std n and drifts by a random walk."""
    for j in range(memory.shape[2]):
        v, _, _, _ = normals(memory, b, j, number)
        if begin:
            memory[b, rows, j] = numbers[at] + numbers[at + 1] * v
        else:
            memory[b, rows, j] += numbers[at + 2] * v
        memory[b, target, j] += memory[b, rows, j]


@inlined
def quantisation(memory, b, target, rows, number, numbers, at, begin):
    """Round to the nearest multiple of a step."""
    step = numbers[at]
    for j in range(memory.shape[2]):  # math.floor would make an integer, which ends at 2^63
        memory[b, target, j] = np.floor(memory[b, target, j] / step + 0.5) * step


@inlined
def saturation(memory, b, target, rows, number, numbers, at, begin):
    """Clip to an interval."""
    for j in range(memory.shape[2]):
        memory[b, target, j] = min(max(memory[b, target, j], numbers[at]), numbers[at + 1])


@inlined
def delay(memory, b, target, rows, number, numbers, at, begin):
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
    act = staticmethod(student_t)

    def __post_init__(self):
        """Check the arguments."""
        set_field(self, "scale", positive("scale", self.scale, zero_allowed=True))
        degrees = finite("degrees", self.degrees)
        if degrees < 1:
            raise ValueError(f"degrees must be at least 1, but got {self.degrees!r}")
        set_field(self, "degrees", degrees)

    def parameters(self, context: Context) -> list[float]:
        """Degrees of freedom and scale."""
        return [self.degrees, self.scale]


@SENSOR_EFFECTS.register("outliers")
@dataclass(frozen=True)
class Outliers(Effect):
    """A mixture: with a probability, a normal variate of a (large) standard deviation comes on top."""

    std: float
    probability: float = 0.05
    act = staticmethod(outliers)

    def __post_init__(self):
        """Check the arguments."""
        set_field(self, "std", positive("std", self.std, zero_allowed=True))
        set_field(self, "probability", probability("probability", self.probability))

    def parameters(self, context: Context) -> list[float]:
        """Probability and standard deviation."""
        return [self.probability, self.std]


@SENSOR_EFFECTS.register("bias")
@dataclass(frozen=True)
class Bias(Effect):
    """A bias of `value`, plus N(0, std^2) drawn once an episode, plus a random walk of `drift` a step."""

    value: float = 0.0
    std: float = 0.0
    drift: float = 0.0
    act = staticmethod(bias)

    def __post_init__(self):
        """Check the arguments."""
        set_field(self, "value", finite("value", self.value))
        set_field(self, "std", positive("std", self.std, zero_allowed=True))
        set_field(self, "drift", positive("drift", self.drift, zero_allowed=True))

    def rows(self, context: Context) -> int:
        """The bias."""
        return 1


@SENSOR_EFFECTS.register("quantisation")
@dataclass(frozen=True)
class Quantisation(Effect):
    """Rounding to the nearest multiple of `step`."""

    step: float
    act = staticmethod(quantisation)

    def __post_init__(self):
        """Check the argument."""
        set_field(self, "step", positive("step", self.step))


@SENSOR_EFFECTS.register("saturation")
@dataclass(frozen=True)
class SensorSaturation(Effect):
    """Clipping to low ... high."""

    low: float
    high: float
    act = staticmethod(saturation)

    def __post_init__(self):
        """Check the arguments."""
        low, high = finite("low", self.low), finite("high", self.high)
        if not low < high:
            raise ValueError(f"low must be less than high, but got {self.low!r} and {self.high!r}")
        set_field(self, "low", low)
        set_field(self, "high", high)


SENSOR_EFFECTS.register("dropout")(Dropout)


@SENSOR_EFFECTS.register("delay")
@dataclass(frozen=True)
class Delay(Effect):
    """A measurement that comes `steps` sample times late; at first, the first one is repeated."""

    steps: int = 1
    act = staticmethod(delay)

    def __post_init__(self):
        """Check the argument."""
        steps = at_least("steps", self.steps, 1)
        if steps > LONGEST_DELAY:
            raise ValueError(f"steps must be at most {LONGEST_DELAY}, but got {self.steps!r}")
        set_field(self, "steps", steps)

    def parameters(self, context: Context) -> list[float]:
        """Steps, and offset of the validity flag."""
        return [self.steps, context.valid_offset]

    def rows(self, context: Context) -> int:
        """Measurements on their way, and whether they are valid."""
        return 2 * self.steps


SENSOR_EFFECTS.register("sample-every")(SampleEvery)
