"""Sensor effects: errors of a measurement beside Gaussian noise.

A channel measures a quantity plus Gaussian noise of covariance R (`measurement_noise_cov`). A list of effects may
follow; each acts on the result of the one before. All amounts are in the channel's unit.
A missing measurement repeats the last valid one (0 before the first) and is marked as not valid.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from thruster_env.core.checks import at_least, finite, positive
from thruster_env.effects.effects import (
    Context,
    Effect,
    Registry,
    checked_probability,
    not_negative,
    set_field,
)
from thruster_env.graphs.graphs import where
from thruster_env.graphs.values import Line

SENSOR_EFFECTS = Registry("sensors")
LONGEST_INTERVAL = 1_000_000  # steps between two samples
LONGEST_DELAY = 10_000  # steps, each of which takes two numbers of every copy's memory


class Reading(NamedTuple):
    """What a sensor's effects change: the measurement, and 1.0 if it is valid, 0.0 if it is missing."""

    z: Any
    valid: Any


def hold_missing(reading: Reading, arrives, last) -> tuple[Reading, Any]:
    """The reading if it arrives, else the last one (0 before the first) as not valid; and the next last one."""
    z = where(arrives, reading.z, 0.0 if last is None else last)
    return Reading(z, where(arrives, reading.valid, 0.0)), z


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

    @staticmethod
    def act(e, reading, memory, t):
        """Add scale times a Student-t variate: Bailey's (1994) form of the transform of Box and Muller."""
        u0, u1, _, _ = t.uniforms()
        radius = (e.degrees * (u0 ** (-2.0 / e.degrees) - 1.0)) ** 0.5
        return reading._replace(z=reading.z + e.scale * radius * math.cos(2.0 * math.pi * u1)), memory


@SENSOR_EFFECTS.register("outliers")
@dataclass(frozen=True)
class Outliers(Effect):
    """A mixture: with a probability, a normal variate of a (large) standard deviation comes on top."""

    std: float
    probability: float = 0.05
    checks = {"std": not_negative, "probability": checked_probability}

    @staticmethod
    def act(e, reading, memory, t):
        """With a probability add a normal variate of a standard deviation."""
        z = where(t.uniforms()[0] < e.probability, reading.z + e.std * t.normals()[0], reading.z)
        return reading._replace(z=z), memory


@SENSOR_EFFECTS.register("bias")
@dataclass(frozen=True)
class Bias(Effect):
    """A bias of `value`, plus N(0, std^2) drawn once an episode, plus a random walk of `drift` a step."""

    value: float = 0.0
    std: float = 0.0
    drift: float = 0.0
    checks = {"value": finite, "std": not_negative, "drift": not_negative}

    @staticmethod
    def act(e, reading, bias, t):
        """Add a bias that starts at value + std n and drifts by a random walk."""
        n = t.normals()[0]
        bias = e.value + e.std * n if t.begin else bias + e.drift * n
        return reading._replace(z=reading.z + bias), bias


@SENSOR_EFFECTS.register("quantisation")
@dataclass(frozen=True)
class Quantisation(Effect):
    """Rounding to the nearest multiple of `step`."""

    step: float
    checks = {"step": positive}

    @staticmethod
    def act(e, reading, memory, t):
        """Round to the nearest multiple of a step."""
        return reading._replace(z=np.floor(reading.z / e.step + 0.5) * e.step), memory


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
    def act(e, reading, memory, t):
        """Clip to an interval."""
        return reading._replace(z=min(max(reading.z, e.low), e.high)), memory


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

    def parameters(self, context: Context) -> dict[str, Any]:
        """Probabilities that a run of missing measurements begins and ends."""
        assert self.mean_length is not None  # it is set when the effect is made
        begins = self.probability / (1.0 - self.probability) / self.mean_length
        return {"begins": begins, "ends": 1.0 / self.mean_length}

    @staticmethod
    def act(e, reading, memory, t):
        """Lose measurements in runs (a two-state Markov chain); a lost one repeats the last and is not valid."""
        (u, _, _, _), (last, was_lost) = t.uniforms(), (None, 0.0) if t.begin else memory
        lost = where(was_lost > 0.0, where(u < e.ends, 0.0, 1.0), where(u < e.begins, 1.0, 0.0))
        reading, last = hold_missing(reading, lost == 0.0, last)
        return reading, (last, lost)


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
    loses = None

    def parameters(self, context: Context) -> dict[str, Any]:
        """Steps, the length of the line."""
        return {"steps": self.steps}

    @staticmethod
    def act(e, reading, line, t):
        """Report the measurement of `steps` steps ago; at first the first measurement."""
        line = Line(e.steps, reading) if t.begin else line
        return line.push(reading)


@SENSOR_EFFECTS.register("sample-every")
@dataclass(frozen=True)
class SampleEvery(Effect):
    """A sensor slower than the plant: a sample every `steps` steps, from step number `first` on.

    Between two samples the measurement is missing, as with `Dropout`. A sensor of 5 Hz on a plant with a step of
    0.05 s has a sample every 4 steps.
    """

    steps: int
    first: int = 0
    loses = True

    def __post_init__(self):
        """Check the arguments."""
        steps = at_least("steps", self.steps, 1, LONGEST_INTERVAL)
        set_field(self, "steps", steps)
        set_field(self, "first", at_least("first", self.first, 0, LONGEST_INTERVAL) % steps)

    @staticmethod
    def act(e, reading, last, t):
        """Take a sample at steps first, first + steps, first + 2 steps, ...; between them the last is repeated."""
        return hold_missing(reading, (t.step - e.first) % e.steps == 0.0, last)
