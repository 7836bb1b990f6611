"""Measurements that are missing: lost at random, or not taken at every step.

A missing measurement repeats the last valid one (0 before the first) and is marked as not valid.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from thruster_env.core.checks import at_least, finite, positive, short_repr, vector, within
from thruster_env.core.compiled import inlined
from thruster_env.core.memory import STEP
from thruster_env.effects.effects import Context, Effect, set_field, uniforms

LONGEST_INTERVAL = 1_000_000  # steps between two samples


@inlined
def hold_missing(memory, b, j, target, last, valid, missing, begin):
    """If copy j's measurement is missing, repeat the last one, stored in row `last`, and mark it as not valid."""
    if begin:
        memory[b, last, j] = 0.0
    if missing:
        memory[b, target, j] = memory[b, last, j]
        memory[b, valid, j] = 0.0
    memory[b, last, j] = memory[b, target, j]


@inlined
def dropout(memory, b, target, rows, number, numbers, at, begin):
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


@inlined
def sample_every(memory, b, target, rows, number, numbers, at, begin):
    """Take a sample at steps first, first + steps, first + 2 steps, ...; between them the last is repeated."""
    steps, first, valid = int(numbers[at]), int(numbers[at + 1]), target + int(numbers[at + 2])
    for j in range(memory.shape[2]):
        between = (int(memory[b, STEP, j]) - first) % steps != 0
        hold_missing(memory, b, j, target, rows, valid, between, begin)


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
    act = staticmethod(dropout)
    loses = True

    def __post_init__(self):
        """Check the arguments."""
        share = probability("probability", self.probability)
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

    def rows(self, context: Context) -> int:
        """The last valid measurement, and whether one is missing."""
        return 2


@dataclass(frozen=True)
class SampleEvery(Effect):
    """A sensor slower than the plant: a sample every `steps` steps, from step number `first` on.

    Between two samples the measurement is missing, as with `Dropout`. A sensor of 5 Hz on a plant with a step of
    0.05 s has a sample every 4 steps.
    """

    steps: int
    first: int = 0
    act = staticmethod(sample_every)
    loses = True

    def __post_init__(self):
        """Check the arguments."""
        steps = at_least("steps", self.steps, 1, LONGEST_INTERVAL)
        set_field(self, "steps", steps)
        set_field(self, "first", at_least("first", self.first, 0, LONGEST_INTERVAL) % steps)

    def parameters(self, context: Context) -> list[float]:
        """Steps between two samples, number of the first one, and offset of the validity flag."""
        return [self.steps, self.first, context.valid_offset]

    def rows(self, context: Context) -> int:
        """The last sample."""
        return 1


def probability(name: str, value) -> float:
    """Return value as a float; raise ValueError unless it lies within 0 and 1."""
    if within(name, value, 1.0) < 0:
        raise ValueError(f"{name} must be at least 0 and at most 1, but got {value!r}")
    return float(value)


# A recorded series, such as a measured wind, as a signal.


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
        """The parameters of `recorded_value`."""
        return [self.sample_time, float(self.repeat), float(len(self._series)), *self._series]


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
