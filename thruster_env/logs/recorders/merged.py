"""A recorder's file as a table: fields with their own times, in one row for each time."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import numpy as np

from thruster_env.core.checks import listed
from thruster_env.logs.columns import INPUT, MEASUREMENT, TIME, Column, Wanted, find_columns, parted
from thruster_env.logs.findings import CLOCK, OUTSIDE, Remark
from thruster_env.logs.grid import SECOND, follows, time_text
from thruster_env.logs.recorders.one_clock import HEADER, RECEIPT, Choice, chosen_clock
from thruster_env.logs.recorders.registry import Format, Samples, check_stamps, read
from thruster_env.logs.table import Table

STAMP = "times"  # header of the rows' times


class Recorded:
    """The fields of a recorder's file that may be columns of a log.

    Attributes:
        path: of the file.
        samples: by name; of a format with stamps, those that are asked for, as one file may have hundreds.
    """

    def __init__(self, path: str | Path, form: Format, asked: Collection[str], stamps: str | None = None):
        """Read the fields that are asked for, "HEADER" or "HEADER[UNIT]"; all of arrays, found by their names.

        `stamps` of a bag is "header" or "receipt", None for what `one_clock` chooses.
        """
        check_stamps(stamps, form, path)
        self.path, self.form, self.stamps = Path(path), form, stamps
        self._asked = {name for text in asked for name in (text, text.rpartition("[")[0].strip()) if name}
        self.is_whole, self.is_timed = not form.has_stamps, False
        self.samples = read(path, None if self.is_whole else self._asked)

    def columns(
        self, wanted: list[Wanted], named: Mapping[str, str], units: Mapping[str, str], needs_time: bool
    ) -> dict[str, Column]:
        """The columns of quantities, as `find_columns` finds them; ValueError names all fields."""
        if self.form.has_stamps and TIME in named:
            rule = f"times of a {self.form.kind} must be the stamps of its messages"
            raise ValueError(f"{rule}, but got time={named[TIME]} ({self.path})")
        self.is_timed = TIME in named  # by a vector for all fields, in place of those beside them
        while True:
            read_units = {name: _unit(name, samples) for name, samples in self.samples.items()}
            unit_of = {name: unit for name, unit in read_units.items() if unit is not None} | dict(units)
            file_units = {name: samples.unit for name, samples in self.samples.items() if samples.unit}
            try:
                columns = find_columns(wanted, [*self.samples], named, unit_of, str(self.path), needs_time)
                return columns if self.form.has_units else _without_units(columns, wanted, file_units)
            except ValueError:
                if self.is_whole:
                    read(self.path, self._asked)  # which says of an array why it is not read
                    raise
            self.samples, self.is_whole = read(self.path, None), True

    def has_times(self, columns: Mapping[str, Column]) -> bool:
        """Whether all columns but that of times have times of their own."""
        return all(self.samples[column.header].times is not None for key, column in columns.items() if key != TIME)

    def table(self, columns: Mapping[str, Column]) -> tuple[Table, Mapping[str, Column]]:
        """The rows of a log and their columns: at the times of all samples, from when all inputs are known.

        The measurement with most samples gives the grid: the log begins and ends with it. Before it, an input's
        last sample counts. Of two samples of a field at one time, the last is used. All fields have the times of
        one clock.

        Args:
            columns: by quantity.

        Raises:
            ValueError: if a field has no times, or they run backwards, or inputs and measurements do not overlap.
        """
        without_time = {key: column for key, column in columns.items() if key != TIME}
        columns = without_time if not self.is_timed and self.has_times(columns) else dict(columns)
        fields = {column.header: self.samples[column.header] for column in columns.values()}
        choice = chosen_clock({name: samples.clocked for name, samples in fields.items()}, self.stamps, self.path)
        fields = {name: samples.by(choice.clock) for name, samples in fields.items()}
        for name, samples in fields.items():
            _check(name, samples, self.path)
        if TIME in columns or all(samples.times is None for samples in fields.values()):
            return _plain(fields, self.path), columns
        for name, samples in fields.items():
            if samples.times is None:
                raise ValueError(
                    f"all fields of a log must have times, but there are none beside {name!r} in {self.path} "
                    f"(use --column time=NAME)"
                )
        inputs, measured = (
            [columns[key].header for key in columns if key.startswith(f"{kind}:")] for kind in (INPUT, MEASUREMENT)
        )
        clock = _clock([fields[name] for name in inputs], [fields[name] for name in measured], self.path)
        apart = np.unique(np.concatenate([_times(samples) for samples in fields.values()]))
        apart = apart[(apart > clock[0]) & (apart < clock[-1])]
        stamps = np.sort(np.concatenate([clock, np.setdiff1d(apart, clock)]), kind="stable")
        cells = {name: _rows(samples, stamps) for name, samples in fields.items()}
        for name in inputs:
            cells[name][0] = fields[name].values[_times(fields[name]) <= stamps[0]][-1]
        rows = range(1, len(stamps) + 1)
        assumptions = dict.fromkeys(part.assumption for part in fields.values() if part.assumption)
        clock_remarks = [Remark(CLOCK, "", text) for text in assumptions]
        is_clock = np.isin(stamps, clock)
        remarks = [*clock_remarks, *_of_choice(choice), *_not_used(columns, fields, clock, self.path)]
        table = Table(str(self.path), {STAMP: stamps, **cells}, rows, "row", is_clock, _damage(fields), remarks)
        return table, {**columns, TIME: Column(STAMP, SECOND)}


MANY = 0.1  # of the samples of a channel outside the log: worth a word


def _of_choice(choice: Choice) -> list[Remark]:
    """Why a bag's topics have the times of reception, where some have others."""
    if not choice.why:
        return []
    sentence = f"all topics have the times at which messages were received, because {choice.why}"
    return [Remark(CLOCK, "", f"{sentence} (stamps, --stamps {HEADER}|{RECEIPT})")]


def _not_used(
    columns: Mapping[str, Column], fields: Mapping[str, Samples], clock: np.ndarray, path: Path
) -> list[Remark]:
    """Channels with many or all samples outside the log; ValueError if these are all samples of a measurement."""
    remarks = []
    for key, column in columns.items():
        times = _times(fields[column.header])
        outside = int(((times < clock[0]) | (times > clock[-1])).sum())
        if outside <= MANY * len(times):
            continue
        dt = float(np.median(np.diff(clock)))
        ends = [time_text(time, dt) for time in (times[0], times[-1], clock[0], clock[-1])]
        where = f"from {ends[0]} to {ends[1]} s, the log from {ends[2]} to {ends[3]} s"
        if outside == len(times) and key.startswith(f"{MEASUREMENT}:"):
            rule = "measurements must have samples in the log"
            raise ValueError(f"{rule}, but those of {column.header} are {where} ({path})")
        count = "all" if outside == len(times) else f"{outside} of {len(times)}"
        text = f"{count} samples of {column.header} lie outside the log: they are {where}"
        remarks.append(Remark(OUTSIDE, key, text))
    return remarks


def _without_units(
    columns: Mapping[str, Column], wanted: Sequence[Wanted], known: Mapping[str, str]
) -> dict[str, Column]:
    """The columns, without a field's unit where the model's quantity has none."""
    plain = {channel.key for channel in wanted if not channel.quantity.unit}
    return {
        key: column._replace(unit=None) if key in plain and column.unit == known.get(column.header) else column
        for key, column in columns.items()
    }


def _unit(name: str, samples: Samples) -> str | None:
    """The unit that a file gives, None if its name may have one; the brackets of "speed_rpm[0]" hold none."""
    return samples.unit or ((parted(name.rpartition("[")[0])[1] or "") if name.endswith("]") else None)


def _times(samples: Samples) -> np.ndarray:
    return np.empty(0) if samples.times is None else samples.times


def _check(name: str, samples: Samples, path: Path) -> None:
    """Raise ValueError for times that are missing or run backwards, and for infinite values; it names the time."""
    times = _times(samples)
    if np.isnan(times).any():
        raise ValueError(f"every sample must have a time, but one of {name!r} in {path} has none")
    if (np.diff(times) < 0).any():
        row = int(np.argmax(np.diff(times) < 0)) + 1
        rule = "times must increase from sample to sample"
        raise ValueError(f"{rule}, but {follows(times[row - 1], times[row])} in {name!r} of {path}")
    if np.isinf(samples.values).any():
        row = int(np.argmax(np.isinf(samples.values)))
        where = f"at {times[row]:.15g} s" if len(times) else f"in row {row + 1}"
        raise ValueError(f"numbers must be finite, but got {samples.values[row]} {where} in {name!r} of {path}")


def _plain(fields: Mapping[str, Samples], path: Path) -> Table:
    """A table of fields of equal length; one of them may hold the times."""
    lengths = {name: len(samples.values) for name, samples in fields.items()}
    if len(set(lengths.values())) > 1:
        sizes = listed(f"{name} {length}" for name, length in lengths.items())
        raise ValueError(f"fields without times of their own must be of equal length, but {path} has {sizes}")
    rows = range(1, next(iter(lengths.values())) + 1)
    cells = {name: samples.values for name, samples in fields.items()}
    return Table(str(path), cells, rows, "row", damage=_damage(fields))


def _damage(fields: Mapping[str, Samples]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(samples.damage for samples in fields.values() if samples.damage))


def _clock(inputs: list[Samples], measured: list[Samples], path: Path) -> np.ndarray:
    """Times of the measurement with most samples, from when all inputs are known."""
    begin = max([-np.inf, *(_times(samples)[0] for samples in inputs if len(samples.values))])
    within = [_times(samples)[_times(samples) >= begin] for samples in measured]
    clock = max(within, key=len, default=np.empty(0))
    if len(clock) < 2:
        end = max((_times(samples)[-1] for samples in measured if len(samples.values)), default=np.nan)
        rule = f"measurements must continue after all inputs have begun, at {begin:.15g} s"
        raise ValueError(f"{rule}, but {path} has {len(clock)} from there on, and they end at {end:.15g} s")
    return clock


def _rows(samples: Samples, stamps: np.ndarray) -> np.ndarray:
    """Samples in the rows of their times, NaN elsewhere; of equal times the last sample, and the last row."""
    rows = np.full(len(stamps), np.nan)
    row = np.searchsorted(stamps, _times(samples), side="right") - 1
    present = (row >= 0) & (stamps[np.maximum(row, 0)] == _times(samples))
    rows[row[present]] = samples.values[present]
    return rows
