"""Signals that add to a disturbance of a plant, such as a flow or a wind, in the unit of that quantity.

A signal is held over a sample time; a function of time is evaluated in its middle. A plant registers the signals
that it has (`Registry.register`).
"""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from thruster_env.core.checks import finite, positive, short_repr, vector
from thruster_env.core.compiled import inlined
from thruster_env.core.memory import STEP
from thruster_env.effects.effects import Context, Effect, normals, not_negative, set_field, uniforms


@inlined
def recorded_value(time, numbers, at):
    """Value of a series at a time [s], linear between samples; numbers: sample time, repeat, count, values."""
    sample_time, repeat, count = numbers[at], numbers[at + 1], int(numbers[at + 2])
    position = max(time / sample_time, 0.0)
    if repeat > 0.0:
        position = position % count
    else:
        position = min(position, count - 1.0)
    before = min(int(position), count - 1)
    after = before + 1
    if after >= count:
        after = 0 if repeat > 0.0 else before
    share = position - before
    return (1.0 - share) * numbers[at + 3 + before] + share * numbers[at + 3 + after]


@dataclass(frozen=True)
class ConstantSignal(Effect):
    """A constant `value`."""

    value: float
    checks = {"value": finite}

    def largest(self) -> float:
        """Its magnitude."""
        return abs(self.value)

    @staticmethod
    @inlined
    def act(memory, b, target, rows, number, numbers, at, begin):
        """Add a constant."""
        for j in range(memory.shape[2]):
            memory[b, target, j] += numbers[at]


@dataclass(frozen=True)
class Sinusoid(Effect):
    """`amplitude` sin(2 pi t/`period` [s] + `phase` [rad]), as waves make it."""

    amplitude: float
    period: float = 4.0
    phase: float = 0.0
    checks = {"amplitude": finite, "period": positive, "phase": finite}

    def largest(self) -> float:
        """The amplitude."""
        return abs(self.amplitude)

    def parameters(self, context: Context) -> list[float]:
        """Amplitude, period [s], phase [rad], sample time [s]."""
        return [self.amplitude, self.period, self.phase, context.dt]

    @staticmethod
    @inlined
    def act(memory, b, target, rows, number, numbers, at, begin):
        """Add amplitude sin(2 pi t/period + phase)."""
        amplitude, period, phase, dt = numbers[at], numbers[at + 1], numbers[at + 2], numbers[at + 3]
        for j in range(memory.shape[2]):
            time = (memory[b, STEP, j] - 0.5) * dt
            memory[b, target, j] += amplitude * math.sin(2.0 * math.pi * time / period + phase)


@dataclass(frozen=True)
class GaussMarkov(Effect):
    """A process of zero mean, standard deviation `std` and correlation exp(-t/`time_constant` [s])."""

    std: float
    time_constant: float = 1.0
    checks = {"std": not_negative, "time_constant": positive}
    row_count = 1  # the process

    def largest(self) -> float:
        """Four standard deviations."""
        return 4.0 * self.std

    def parameters(self, context: Context) -> list[float]:
        """Standard deviation and the correlation of neighbouring steps."""
        return [self.std, math.exp(-context.dt / self.time_constant)]

    @staticmethod
    @inlined
    def act(memory, b, target, rows, number, numbers, at, begin):
        """Add a first-order Gauss-Markov process, x' = a x + s sqrt(1 - a^2) n, stationary from the start."""
        std, decay = numbers[at], numbers[at + 1]
        spread = (1.0 - decay * decay) ** 0.5
        for j in range(memory.shape[2]):
            n, _, _, _ = normals(memory, b, j, number)
            memory[b, rows, j] = std * n if begin else decay * memory[b, rows, j] + std * spread * n
            memory[b, target, j] += memory[b, rows, j]


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
    checks = {"std": not_negative, "rate": not_negative, "duration": positive}
    row_count = 2  # time since the gust began, and its height

    def largest(self) -> float:
        """Four standard deviations of the height [m/s]."""
        return 4.0 * self.std

    def parameters(self, context: Context) -> list[float]:
        """Probability that one begins in a calm step, standard deviation, duration [s], sample time [s]."""
        return [1.0 - math.exp(-self.rate * context.dt), self.std, self.duration, context.dt]

    @staticmethod
    @inlined
    def act(memory, b, target, rows, number, numbers, at, begin):
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


@dataclass(frozen=True)
class RecordedSeries(Effect):
    """A series given by its `values`, or by a `file` that holds them in a column, one every `sample_time`.

    Args:
        values: numbers in SI units.
        sample_time: between two values [s].
        repeat: start again after the last value; otherwise the last one stays.
        file: a CSV file with a header line, read when the effect is made; instead of `values`.
        column: name of the column in it.
    """

    values: tuple[float, ...] | None = None
    sample_time: float = 0.01
    repeat: bool = False
    file: str | None = None
    column: str | None = None

    def __post_init__(self):
        """Read the file, if there is one, and check the arguments."""
        if (self.values is None) == (self.file is None):
            raise ValueError(f"either values or file must be given, but got {self.values!r} and {self.file!r}")
        values = self.values if self.file is None else _column(self.file, self.column)
        set_field(self, "values", tuple(vector("values", values).tolist()))
        set_field(self, "sample_time", positive("sample_time", self.sample_time))
        set_field(self, "repeat", bool(self.repeat))

    @property
    def _series(self) -> tuple[float, ...]:
        return self.values or ()  # never None once it is made

    def as_mapping(self) -> dict:
        """Name and arguments; a file stays a file."""
        mapping = super().as_mapping()
        mapping["values"] = None if self.file is not None else list(self._series)
        return mapping

    def largest(self) -> float:
        """Largest magnitude in the series."""
        return max(map(abs, self._series))

    def parameters(self, context: Context) -> list[float]:
        """The plant's sample time [s], and the parameters of `recorded_value`."""
        return [context.dt, self.sample_time, float(self.repeat), float(len(self._series)), *self._series]


def _column(file: str, column: str | None) -> np.ndarray:
    path = Path(file)
    if not path.is_file() or not path.stat().st_size:
        raise ValueError(f"file must be a CSV file that exists and is not empty, but got {short_repr(file)}")
    with path.open(newline="", encoding="utf-8-sig") as lines:
        names, *rows = ([entry.strip() for entry in row] for row in csv.reader(lines) if row)
    names[0] = names[0].removeprefix("#").strip()  # headers are comments to some programs
    if column not in names:
        raise ValueError(f"column must be one of {', '.join(names)}, but got {column!r}")
    if any(len(row) != len(names) for row in rows):
        raise ValueError(f"file must be a CSV file with a header line over equally long rows, but {file!r} is not")
    entries = [row[names.index(column)] for row in rows]
    try:
        return np.array(entries, dtype=np.float64)
    except ValueError:
        raise ValueError(f"values must be some finite numbers, but got {short_repr(entries)}") from None


@dataclass(frozen=True)
class RecordedSignal(RecordedSeries):
    """A recorded signal."""

    @staticmethod
    @inlined
    def act(memory, b, target, rows, number, numbers, at, begin):
        """Add a recorded series."""
        for j in range(memory.shape[2]):
            time = (memory[b, STEP, j] - 0.5) * numbers[at]
            memory[b, target, j] += recorded_value(time, numbers, at + 1)
