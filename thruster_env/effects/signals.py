"""Signals that add to a disturbance of a plant, such as a flow or a wind, in the unit of that quantity.

A signal is held over a sample time; a function of time is evaluated in its middle. A plant registers the signals
that it has (`Registry.register`).
"""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from thruster_env.core.checks import finite, positive, short_repr, vector
from thruster_env.effects.effects import Context, Effect, not_negative, set_field
from thruster_env.graphs.graphs import where


def recorded_value(e, time):
    """The value at a time [s] of a series e with its sample time, linear between its values."""
    position, count = max(time / e.sample_time, 0.0), e.series.count
    position = position % count if e.repeat else min(position, count - 1.0)
    before = min(np.floor(position), count - 1.0)
    after = where(before + 1.0 < count, before + 1.0, 0.0 if e.repeat else before)
    share = position - before
    return (1.0 - share) * e.series[before] + share * e.series[after]


@dataclass(frozen=True)
class ConstantSignal(Effect):
    """A constant `value`."""

    value: float
    checks = {"value": finite}

    def largest(self) -> float:
        """Its magnitude."""
        return abs(self.value)

    @staticmethod
    def act(e, value, memory, t):
        """Add a constant."""
        return value + e.value, memory


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

    @staticmethod
    def act(e, value, memory, t):
        """Add amplitude sin(2 pi t/period + phase)."""
        time = (t.step - 0.5) * t.dt
        return value + e.amplitude * math.sin(2.0 * math.pi * time / e.period + e.phase), memory


@dataclass(frozen=True)
class GaussMarkov(Effect):
    """A process of zero mean, standard deviation `std` and correlation exp(-t/`time_constant` [s])."""

    std: float
    time_constant: float = 1.0
    checks = {"std": not_negative, "time_constant": positive}

    def largest(self) -> float:
        """Four standard deviations."""
        return 4.0 * self.std

    def parameters(self, context: Context) -> dict[str, Any]:
        """Standard deviation and the correlation of neighbouring steps."""
        return {"std": self.std, "decay": math.exp(-context.dt / self.time_constant)}

    @staticmethod
    def act(e, value, x, t):
        """Add a first-order Gauss-Markov process, x' = a x + s sqrt(1 - a^2) n, stationary from the start."""
        n = t.normals()[0]
        x = e.std * n if t.begin else e.decay * x + e.std * (1.0 - e.decay * e.decay) ** 0.5 * n
        return value + x, x


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

    def largest(self) -> float:
        """Four standard deviations of the height [m/s]."""
        return 4.0 * self.std

    def parameters(self, context: Context) -> dict[str, Any]:
        """Probability that one begins in a calm step, standard deviation, duration [s]."""
        chance = 1.0 - math.exp(-self.rate * context.dt)
        return {"chance": chance, "std": self.std, "duration": self.duration}

    @staticmethod
    def act(e, value, memory, t):
        """Add gusts that begin at random; each is height/2 (1 - cos(2 pi t/duration)), with a normal height."""
        since, height = (e.duration, 0.0) if t.begin else memory
        since = since + t.dt
        begins = (since >= e.duration) & (t.uniforms()[0] < e.chance)
        since, height = where(begins, 0.5 * t.dt, since), where(begins, e.std * t.normals()[0], height)
        gust = 0.5 * height * (1.0 - math.cos(2.0 * math.pi * since / e.duration))
        return value + where(since < e.duration, gust, 0.0), (since, height)


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

    def parameters(self, context: Context) -> dict[str, Any]:
        """The parameters of `recorded_value`."""
        return {"sample_time": self.sample_time, "repeat": int(self.repeat), "series": np.array(self._series)}


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
    def act(e, value, memory, t):
        """Add a recorded series."""
        return value + recorded_value(e, (t.step - 0.5) * t.dt), memory
