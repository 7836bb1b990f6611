"""Signals that add to a disturbance of a plant, such as a flow or a wind, in the unit of that quantity.

A signal is held over a sample time; a function of time is evaluated in its middle. A plant registers the signals
that it has (`Registry.register`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from thruster_env.core.checks import finite, positive
from thruster_env.core.compiled import inlined
from thruster_env.core.memory import STEP
from thruster_env.effects.effects import Context, Effect, normals, set_field, uniforms
from thruster_env.effects.missing import RecordedSeries, recorded_value


@inlined
def constant(memory, b, target, rows, number, numbers, at, begin):
    """Add a constant."""
    for j in range(memory.shape[2]):
        memory[b, target, j] += numbers[at]


@inlined
def sinusoid(memory, b, target, rows, number, numbers, at, begin):
    """Add amplitude sin(2 pi t/period + phase)."""
    amplitude, period, phase, dt = numbers[at], numbers[at + 1], numbers[at + 2], numbers[at + 3]
    for j in range(memory.shape[2]):
        time = (memory[b, STEP, j] - 0.5) * dt
        memory[b, target, j] += amplitude * math.sin(2.0 * math.pi * time / period + phase)


@inlined
def gauss_markov(memory, b, target, rows, number, numbers, at, begin):
    """Add a first-order Gauss-Markov process, x' = a x + s sqrt(1 - a^2) n, stationary from the start."""
    std, decay = numbers[at], numbers[at + 1]
    spread = (1.0 - decay * decay) ** 0.5
    for j in range(memory.shape[2]):
        n, _, _, _ = normals(memory, b, j, number)
        memory[b, rows, j] = std * n if begin else decay * memory[b, rows, j] + std * spread * n
        memory[b, target, j] += memory[b, rows, j]


@inlined
def gusts(memory, b, target, rows, number, numbers, at, begin):
    """Add gusts that begin at random; each is height/2 (1 - cos(2 pi t/duration)), with a normal height."""
    chance, std, duration, dt = numbers[at], numbers[at + 1], numbers[at + 2], numbers[at + 3]
    since, height = rows, rows + 1
    for j in range(memory.shape[2]):
        u, _, _, _ = uniforms(memory, b, j, number)
        n, _, _, _ = normals(memory, b, j, number)
        if begin:
            memory[b, since, j] = duration
        memory[b, since, j] += dt
        if memory[b, since, j] >= duration and u < chance:
            memory[b, since, j] = 0.5 * dt
            memory[b, height, j] = std * n
        if memory[b, since, j] < duration:
            turn = 2.0 * math.pi * memory[b, since, j] / duration
            memory[b, target, j] += 0.5 * memory[b, height, j] * (1.0 - math.cos(turn))


@inlined
def recorded(memory, b, target, rows, number, numbers, at, begin):
    """Add a recorded series."""
    for j in range(memory.shape[2]):
        time = (memory[b, STEP, j] - 0.5) * numbers[at]
        memory[b, target, j] += recorded_value(time, numbers, at + 1)


@dataclass(frozen=True)
class ConstantSignal(Effect):
    """A constant `value`."""

    value: float
    act = staticmethod(constant)

    def __post_init__(self):
        """Check the argument."""
        set_field(self, "value", finite("value", self.value))

    def largest(self) -> float:
        """Its magnitude."""
        return abs(self.value)


@dataclass(frozen=True)
class Sinusoid(Effect):
    """`amplitude` sin(2 pi t/`period` [s] + `phase` [rad]), as waves make it."""

    amplitude: float
    period: float = 4.0
    phase: float = 0.0
    act = staticmethod(sinusoid)

    def __post_init__(self):
        """Check the arguments."""
        set_field(self, "amplitude", finite("amplitude", self.amplitude))
        set_field(self, "period", positive("period", self.period))
        set_field(self, "phase", finite("phase", self.phase))

    def largest(self) -> float:
        """The amplitude."""
        return abs(self.amplitude)

    def parameters(self, context: Context) -> list[float]:
        """Amplitude, period [s], phase [rad], sample time [s]."""
        return [self.amplitude, self.period, self.phase, context.dt]


@dataclass(frozen=True)
class GaussMarkov(Effect):
    """A process of zero mean, standard deviation `std` and correlation exp(-t/`time_constant` [s])."""

    std: float
    time_constant: float = 1.0
    act = staticmethod(gauss_markov)

    def __post_init__(self):
        """Check the arguments."""
        set_field(self, "std", positive("std", self.std, zero_allowed=True))
        set_field(self, "time_constant", positive("time_constant", self.time_constant))

    def largest(self) -> float:
        """Four standard deviations."""
        return 4.0 * self.std

    def parameters(self, context: Context) -> list[float]:
        """Standard deviation and the correlation of neighbouring steps."""
        return [self.std, math.exp(-context.dt / self.time_constant)]

    def rows(self, context: Context) -> int:
        """The process."""
        return 1


@dataclass(frozen=True)
class Gusts(Effect):
    """One-minus-cosine gusts that begin at random while none is under way.

    Args:
        std: standard deviation of a gust's height.
        rate: gusts that begin per second of calm [1/s].
        duration: of a gust [s].
    """

    std: float
    rate: float = 0.5
    duration: float = 0.5
    act = staticmethod(gusts)

    def __post_init__(self):
        """Check the arguments."""
        set_field(self, "std", positive("std", self.std, zero_allowed=True))
        set_field(self, "rate", positive("rate", self.rate, zero_allowed=True))
        set_field(self, "duration", positive("duration", self.duration))

    def largest(self) -> float:
        """Four standard deviations of the height [m/s]."""
        return 4.0 * self.std

    def parameters(self, context: Context) -> list[float]:
        """Probability that one begins in a calm step, standard deviation, duration [s], sample time [s]."""
        return [1.0 - math.exp(-self.rate * context.dt), self.std, self.duration, context.dt]

    def rows(self, context: Context) -> int:
        """Time since the gust began and its height."""
        return 2


@dataclass(frozen=True)
class RecordedSignal(RecordedSeries):
    """A recorded signal."""

    act = staticmethod(recorded)

    def parameters(self, context: Context) -> list[float]:
        """The plant's sample time [s], and the parameters of `recorded_value`."""
        return [context.dt, *super().parameters(context)]
