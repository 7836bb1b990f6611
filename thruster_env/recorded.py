"""A recorded series as a signal: flow or reference that somebody measured."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from thruster_env.checks import positive, shown, vector
from thruster_env.compiled import inlined
from thruster_env.effects import Effect, Surroundings, set_field


@inlined
def recorded_value(time, numbers, at):
    """Value of a series at a time [s], linear between samples; numbers: sample time, repeat, count, values."""
    sample_time, repeat, count = numbers[at], numbers[at + 1], int(numbers[at + 2])
    place = max(time / sample_time, 0.0)
    if repeat > 0.0:
        place = place % count
    else:
        place = min(place, count - 1.0)
    before = min(int(place), count - 1)
    after = before + 1
    if after >= count:
        after = 0 if repeat > 0.0 else before
    share = place - before
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

    def as_mapping(self) -> dict:
        """Name and arguments; a file stays a file."""
        mapping = super().as_mapping()
        mapping["values"] = None if self.file is not None else list(self.values)
        return mapping

    def largest(self) -> float:
        """Largest magnitude in the series."""
        return max(map(abs, self.values))

    def parameters(self, around: Surroundings) -> list[float]:
        """What `recorded_value` takes."""
        return [self.sample_time, float(self.repeat), float(len(self.values)), *self.values]


def _column(file: str, column: str | None) -> np.ndarray:
    path = Path(file)
    if not path.is_file() or not path.stat().st_size:
        raise ValueError(f"file must be a CSV file that exists and is not empty, but got {shown(file)}")
    try:
        table = np.genfromtxt(path, delimiter=",", names=True, dtype=np.float64, encoding="utf-8")
    except ValueError as error:
        raise ValueError(f"file must be a CSV file with a header line, but {file!r} is not: {error}") from None
    names = table.dtype.names or ()
    if column not in names:
        raise ValueError(f"column must be one of {', '.join(names)}, but got {column!r}")
    return np.atleast_1d(table[column])
