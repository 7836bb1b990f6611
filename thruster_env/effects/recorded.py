"""A recorded series, such as a measured wind, as a signal."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from thruster_env.core.checks import positive, short_repr, vector
from thruster_env.core.compiled import inlined
from thruster_env.effects.effects import Context, Effect, set_field


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
        """What `recorded_value` takes."""
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
