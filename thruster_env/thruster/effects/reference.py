"""Reference thrust: signals that the thruster has to follow; those of a list are added.

Levels are fractions of T_max, the steady thrust at max_voltage, so that one reference fits every preset. Random
values are drawn for each episode. Observation k holds r_{k+1}, so each signal works one step ahead.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from thruster_env.core.checks import finite, positive, short_repr, vector
from thruster_env.core.compiled import inlined
from thruster_env.core.memory import KEY_0, KEY_1, STEP
from thruster_env.core.streams import REFERENCE_SIGNAL, normal_block, uniform_block
from thruster_env.effects.effects import LONGEST, Effect, Registry, set_field
from thruster_env.effects.missing import RecordedSeries, recorded_value
from thruster_env.effects.signals import constant
from thruster_env.thruster.effects.amplifier import ThrusterContext
from thruster_env.thruster.engine.memory import SAMPLE_TIME

REFERENCE_SIGNALS = Registry("reference")


@inlined
def _uniform(memory, b, j, number, index):
    u, _, _, _ = uniform_block(number, index, REFERENCE_SIGNAL, memory[b, KEY_0, j], memory[b, KEY_1, j])
    return u


@inlined
def steps(memory, b, target, rows, number, numbers, at, begin):
    """Add levels that are drawn from an interval and held."""
    low, high, hold = numbers[at], numbers[at + 1], numbers[at + 2]
    for j in range(memory.shape[2]):
        part = math.floor((memory[b, STEP, j] + 1.0) / hold)
        u = _uniform(memory, b, j, number, part)
        memory[b, target, j] += low + (high - low) * u


@inlined
def ramps(memory, b, target, rows, number, numbers, at, begin):
    """Add straight lines between levels that are drawn from an interval."""
    low, high, hold = numbers[at], numbers[at + 1], numbers[at + 2]
    for j in range(memory.shape[2]):
        position = (memory[b, STEP, j] + 1.0) / hold
        part = math.floor(position)
        before, after = _uniform(memory, b, j, number, part), _uniform(memory, b, j, number, part + 1.0)
        memory[b, target, j] += low + (high - low) * (before + (position - part) * (after - before))


@inlined
def binary_sequence(memory, b, target, rows, number, numbers, at, begin):
    """Add a pseudo-random binary sequence: one of two levels, drawn and held."""
    low, high, hold = numbers[at], numbers[at + 1], numbers[at + 2]
    for j in range(memory.shape[2]):
        part = math.floor((memory[b, STEP, j] + 1.0) / hold)
        u = _uniform(memory, b, j, number, part)
        memory[b, target, j] += high if u < 0.5 else low


@inlined
def multi_sine(memory, b, target, rows, number, numbers, at, begin):
    """Add sines of equal amplitude with phases that are drawn."""
    offset, amplitude, count = numbers[at], numbers[at + 1], int(numbers[at + 2])
    for j in range(memory.shape[2]):
        memory[b, target, j] += offset
        for i in range(count):
            if begin:
                u = _uniform(memory, b, j, number, i)
                memory[b, rows + i, j] = 2.0 * math.pi * u
            time = (memory[b, STEP, j] + 1.0) * numbers[SAMPLE_TIME]
            phase = 2.0 * math.pi * time / numbers[at + 3 + i] + memory[b, rows + i, j]
            memory[b, target, j] += amplitude * math.sin(phase)


@inlined
def band_limited_noise(memory, b, target, rows, number, numbers, at, begin):
    """Add white noise through a low-pass, x' = A x + b n, r = c x, stationary from the start."""
    offset = numbers[at]
    for j in range(memory.shape[2]):
        step = memory[b, STEP, j] + 1.0
        n, m, _, _ = normal_block(number, step, REFERENCE_SIGNAL, memory[b, KEY_0, j], memory[b, KEY_1, j])
        x, y = memory[b, rows, j], memory[b, rows + 1, j]
        if begin:
            memory[b, rows, j] = numbers[at + 9] * n
            memory[b, rows + 1, j] = numbers[at + 10] * n + numbers[at + 11] * m
        else:
            memory[b, rows, j] = numbers[at + 1] * x + numbers[at + 2] * y + numbers[at + 5] * n
            memory[b, rows + 1, j] = numbers[at + 3] * x + numbers[at + 4] * y + numbers[at + 6] * n
        memory[b, target, j] += offset
        memory[b, target, j] += numbers[at + 7] * memory[b, rows, j] + numbers[at + 8] * memory[b, rows + 1, j]


@inlined
def recorded(memory, b, target, rows, number, numbers, at, begin):
    """Add a recorded series."""
    for j in range(memory.shape[2]):
        time = (memory[b, STEP, j] + 1.0) * numbers[SAMPLE_TIME]
        memory[b, target, j] += recorded_value(time, numbers, at)


@REFERENCE_SIGNALS.register("constant")
@dataclass(frozen=True)
class Constant(Effect):
    """One `level` [T_max], or one `thrust` [N]."""

    level: float | None = None
    thrust: float | None = None
    act = staticmethod(constant)

    def __post_init__(self):
        """Check the arguments."""
        if (self.level is None) == (self.thrust is None):
            rule = "either level or thrust of a constant must be given"
            raise ValueError(f"{rule}, but got {self.level!r} and {self.thrust!r}")
        name = "level" if self.thrust is None else "thrust"
        set_field(self, name, finite(name, getattr(self, name)))

    def parameters(self, context: ThrusterContext) -> list[float]:
        """The thrust [N]."""
        if self.level is not None:
            return [self.level * context.thrust_scale]
        assert self.thrust is not None  # one of the two is given
        return [self.thrust]


def held_time(name: str, value) -> float:
    """Return a time for which a level is held [s]; raise ValueError unless it is positive and at most LONGEST."""
    if (time := positive(name, value)) > LONGEST:
        raise ValueError(f"{name} must be at most {LONGEST:g} s, but got {short_repr(value)}")
    return time


@dataclass(frozen=True)
class _Levels(Effect):
    """Levels between `low` and `high` [T_max], a new one every `hold_time` [s]."""

    low: float = 0.1
    high: float = 0.8
    hold_time: float = 1.0

    def __post_init__(self):
        """Check the arguments."""
        low, high = finite("low", self.low), finite("high", self.high)
        if low > high:
            raise ValueError(f"low must be at most high, but got {self.low!r} and {self.high!r}")
        set_field(self, "low", low)
        set_field(self, "high", high)
        set_field(self, "hold_time", held_time("hold_time", self.hold_time))

    def parameters(self, context: ThrusterContext) -> list[float]:
        """Lowest and highest level [N], steps between two levels."""
        hold = max(1.0, round(self.hold_time / context.dt))
        return [self.low * context.thrust_scale, self.high * context.thrust_scale, hold]


@REFERENCE_SIGNALS.register("steps")
@dataclass(frozen=True)
class Steps(_Levels):
    """Levels drawn between `low` and `high` [T_max], each held for `hold_time` [s]."""

    act = staticmethod(steps)


@REFERENCE_SIGNALS.register("ramps")
@dataclass(frozen=True)
class Ramps(_Levels):
    """Straight lines between levels drawn from `low` to `high` [T_max], each line taking `hold_time` [s]."""

    act = staticmethod(ramps)


@REFERENCE_SIGNALS.register("prbs")
@dataclass(frozen=True)
class BinarySequence(_Levels):
    """Pseudo-random binary sequence: `low` or `high` [T_max] with equal chance, drawn every `hold_time` [s]."""

    act = staticmethod(binary_sequence)


@REFERENCE_SIGNALS.register("multi-sine")
@dataclass(frozen=True)
class MultiSine(Effect):
    """Sines of equal `amplitude` [T_max], given `periods` [s] and drawn phases, added to `offset` [T_max]."""

    amplitude: float = 0.1
    offset: float = 0.4
    periods: tuple[float, ...] = (4.0, 1.7, 0.7)
    act = staticmethod(multi_sine)

    def __post_init__(self):
        """Check the arguments."""
        set_field(self, "amplitude", finite("amplitude", self.amplitude))
        set_field(self, "offset", finite("offset", self.offset))
        periods = tuple(positive("periods", period) for period in vector("periods", self.periods))
        set_field(self, "periods", periods)

    def parameters(self, context: ThrusterContext) -> list[float]:
        """Offset and amplitude [N], number of sines, their periods [s]."""
        scale = context.thrust_scale
        return [self.offset * scale, self.amplitude * scale, float(len(self.periods)), *self.periods]

    def rows(self, context: ThrusterContext) -> int:
        """The phases."""
        return len(self.periods)


LEAST_BANDWIDTH = 1e-5  # of the sample rate; a narrower low-pass is lost in rounding


@REFERENCE_SIGNALS.register("band-limited-noise")
@dataclass(frozen=True)
class BandLimitedNoise(Effect):
    """Gaussian noise of standard deviation `std` [T_max] about `offset`, below `bandwidth` [Hz].

    White noise through a second-order Butterworth low-pass.
    """

    std: float = 0.15
    offset: float = 0.4
    bandwidth: float = 0.5
    act = staticmethod(band_limited_noise)

    def __post_init__(self):
        """Check the arguments."""
        set_field(self, "std", positive("std", self.std, zero_allowed=True))
        set_field(self, "offset", finite("offset", self.offset))
        set_field(self, "bandwidth", positive("bandwidth", self.bandwidth))

    def parameters(self, context: ThrusterContext) -> list[float]:
        """Offset [N]; A, b, c of the filter with unit variance times std [N]; root of the state's covariance."""
        from scipy.linalg import solve_discrete_lyapunov
        from scipy.signal import butter, tf2ss

        low, high = LEAST_BANDWIDTH / context.dt, 0.5 / context.dt
        if not low <= self.bandwidth < high:
            rule = f"at least {low:g} Hz and below {high:g} Hz at this dt"
            raise ValueError(f"bandwidth must be {rule}, but got {self.bandwidth}")
        a, b, c, _ = tf2ss(*butter(2, self.bandwidth, fs=1.0 / context.dt))
        cov = solve_discrete_lyapunov(a, b @ b.T)
        c = c * self.std * context.thrust_scale / float((c @ cov @ c.T).item()) ** 0.5
        root = np.linalg.cholesky(cov)
        numbers = [*a.ravel(), *b.ravel(), *c.ravel(), root[0, 0], root[1, 0], root[1, 1]]
        return [self.offset * context.thrust_scale, *map(float, numbers)]

    def rows(self, context: ThrusterContext) -> int:
        """The states of the low-pass."""
        return 2


@REFERENCE_SIGNALS.register("recorded")
@dataclass(frozen=True)
class RecordedReference(RecordedSeries):
    """A recorded reference thrust; its values are in newtons."""

    act = staticmethod(recorded)
