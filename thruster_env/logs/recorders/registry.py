"""Recorders' files by their ending and first bytes: their fields, and the samples of chosen fields as a table.

The table has one row for each time of any chosen field.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from thruster_env.core.checks import listed, one_of
from thruster_env.logs.columns import INPUT, MEASUREMENT, TIME, Column, find_columns, parted
from thruster_env.logs.columns import Wanted as MergedWanted
from thruster_env.logs.findings import CLOCK, OUTSIDE, Remark
from thruster_env.logs.recorders import arrays, autopilots, bags, tables
from thruster_env.logs.recorders.bag_counts import METADATA
from thruster_env.logs.recorders.bags import HEADER, RECEIPT, STAMPS, Choice, Clocked, chosen_clock
from thruster_env.logs.recorders.topics import Format, Topic, Wanted, unreadable
from thruster_env.logs.table import SUFFIXES, Table, read_table
from thruster_env.logs.times import SECOND, follows, in_seconds, time_text

BINS = 8  # of the course of a field
STAMP = "times"  # header of the rows' times
MANY = 0.1  # of the samples of a channel outside the log: worth a word


TABLES = Format(
    tables.KIND,
    (tables.ZIP,),
    tables.ZIP_MAGIC,
    partial(tables.topics_of_tables, read=read_table),
    has_stamps=False,
)
FORMATS = (
    *(autopilots.ULOG, autopilots.DATAFLASH),
    *(bags.ROS1_BAG, bags.MCAP_FILE, bags.ROS2_BAG),
    *(arrays.MATLAB, arrays.HDF5, TABLES),
)
ENDINGS = tuple(ending for form in FORMATS for ending in form.endings)


class Samples(NamedTuple):
    """A field's samples by their own times."""

    times: np.ndarray | None  # (samples,) [s]; None where the file has none for it
    values: np.ndarray  # (samples,)
    unit: str  # empty where the file has none
    damage: str = ""  # what of the file is not read because it is damaged, in words
    clock: str = ""  # "header" or "receipt" in a bag
    received: np.ndarray | None = None  # (samples,) [s]; None where the times are these, or a file has no such
    assumption: str = ""  # how times without a unit were read, in words

    @property
    def clocked(self) -> Clocked:
        """Its times, to choose one clock for all."""
        return Clocked(self.clock, np.empty(0) if self.times is None else self.times, self.received)

    def by(self, clock: str) -> Samples:
        """These samples by the times at which they were received, or as they are."""
        if clock != RECEIPT or self.received is None:
            return self
        order = self.clocked.order
        return self._replace(times=self.received[order], values=self.values[order], clock=RECEIPT, received=None)


class Field(NamedTuple):
    """The size, rate and range of a field; NaN without times or finite numbers."""

    name: str  # of its column, TOPIC.FIELD
    topic: str  # empty for an array that stands alone
    samples: int
    rate: float  # [Hz], over the whole field
    gap: float  # [s], the longest between two samples
    begin: float  # [s], of its times
    end: float
    clock: str  # of its times: "header" or "receipt" in a bag, else empty
    unit: str  # empty where the file has none
    least: float
    greatest: float
    course: tuple[float, ...]  # means of at most BINS parts, NaN for one without numbers


class Contents(NamedTuple):
    """What is in a recorder's file."""

    fields: list[Field]  # that hold numbers, in order of topics
    unread: dict[str, str]  # why others are not read, by name
    damage: tuple[str, ...]  # what of the file is damaged, in words


def format_of(path: str | Path) -> Format | None:
    """The format of a recorder's file, by its ending, else by its first bytes; None for any other file.

    Raises:
        ValueError: if a file's first bytes are not those of its ending, or it cannot be read.
    """
    path = Path(path)
    named = next((form for form in FORMATS if path.suffix.lower() in form.endings), None)
    if (path / METADATA).is_file():
        return next(form for form in FORMATS if ".db3" in form.endings)
    if tables.is_folder(path) or tables.has_clocks(path):
        return TABLES
    if path.is_dir() and named is not None:
        raise unreadable(named.kind, path, "it is a folder")
    if named is None and (path.suffix.lower() in SUFFIXES or not path.is_file()):
        return None
    try:
        with path.open("rb") as file:
            first = file.read(max(len(form.magic) for form in FORMATS))
    except OSError as error:
        raise ValueError(f"a log must be a file that can be read, but {path} is not: {error.strerror}") from None
    begun = next((form for form in FORMATS if first.startswith(form.magic)), None)
    if named is not None and begun is not named:
        why = "it is empty" if not first else f"it begins with {first[:8]!r}"
        raise unreadable(named.kind, path, why if begun is None else f"it is a {begun.kind}")
    return begun


def contents(path: str | Path, stamps: str | None = None) -> Contents:
    """All numeric fields of a recorder's file or a table, and the reasons why others are not read.

    Args:
        path: of the file.
        stamps: of a bag, the clock of all topics: "header" or "receipt", as in
            `thruster_env.logs.recorders.bags`; of topics without stamps in headers always "receipt".
            By default that of headers if all topics have stamps of one clock.

    Raises:
        ValueError: if it is no recorder's file and no table, or is damaged; the message is one line.
    """
    if Path(path).suffix.lower() in SUFFIXES and format_of(path) is None:
        check_stamps(stamps, None, path)
        return _of_table(read_table(path))
    form = _known(path)
    check_stamps(stamps, form, path)
    listed, entries, clocked = list[Field](), list[tuple[str, str, Samples]](), dict[str, Clocked]()
    unread, damage = dict[str, str](), dict[str, None]()
    for topic in form.topics(Path(path), None):
        entries += [(topic.name, *column) for column in _samples(topic)]
        clocked |= {topic.name: entries[-1][2].clocked} if topic.clock and topic.values else {}
        unread |= {topic.column(name) if name else topic.name: why for name, why in topic.unread.items()}
        damage |= {topic.damage: None} if topic.damage else {}
        if not form.has_receipt:  # nothing has to be known of all topics first
            listed += [_field(name, topic, samples) for topic, name, samples in entries]
            entries.clear()
    clock = stamps or chosen_clock(clocked, None, Path(path)).clock
    listed += [_field(name, topic, samples.by(clock)) for topic, name, samples in entries]
    return Contents(listed, unread, tuple(damage))


def _of_table(table: Table) -> Contents:
    """The columns of a table, with the rate of its times, where it has some."""
    clock, times = find_columns([], table.names, {}, {}, table.file).get(TIME), None
    if clock is not None:
        try:
            times = table.dates(clock.header)
            if times is None:
                where = f"column {clock.header!r} of {table.file}"
                times = in_seconds(table.numbers(clock.header), clock.unit, clock.header, where)[0]
        except ValueError:  # the column is listed, or why it is not
            pass
    listed, unread = list[Field](), dict[str, str]()
    for name in table.names:
        try:
            values = table.numbers(name)
        except ValueError as error:
            unread[name] = "dates" if clock and name == clock.header and times is not None else str(error)
        else:
            present = ~np.isnan(values) & (True if times is None else ~np.isnan(times))
            known_times = times[present] if times is not None else None
            listed.append(_field(name, "", Samples(known_times, values[present], parted(name)[1] or "")))
    return Contents(listed, unread, ())


def fields(path: str | Path, stamps: str | None = None) -> list[Field]:
    """All fields of a recorder's file that hold numbers, in order of topics; raises as `contents`."""
    _known(path)
    return contents(path, stamps).fields


def check_stamps(stamps: str | None, form: Format | None, path: str | Path) -> None:
    """Raise ValueError for a choice of stamps that is none, or of a file whose messages have one time."""
    if stamps is None:
        return
    one_of("stamps (--stamps)", stamps, STAMPS)
    if form is None or not form.has_receipt:
        what = "a table" if form is None else f"a {form.kind}"
        raise ValueError(f"stamps (--stamps) must be chosen for a bag, but got {stamps!r} for {what}, {path}")


def read(path: str | Path, names: Collection[str] | None) -> dict[str, Samples]:
    """The samples of fields by name, None for all; names that the file does not have are left out.

    Args:
        path: of the file.
        names: of columns, TOPIC.FIELD.

    Raises:
        ValueError: as `contents`.
    """
    wanted: Wanted = None if names is None else frozenset(names)
    return {
        name: samples
        for topic in _known(path).topics(Path(path), wanted)
        for name, samples in _samples(topic)
        if wanted is None or name in wanted
    }


def _samples(topic: Topic) -> Iterator[tuple[str, Samples]]:
    for name, values in topic.values.items():
        unit = topic.units.get(name, "")
        yield topic.column(name), Samples(topic.times, values, unit, topic.damage, *topic[6:])


def _known(path: str | Path) -> Format:
    form = format_of(path)
    if form is None:
        kinds = ", ".join(ENDINGS)
        raise ValueError(
            f"a recorder's file must end in {kinds} or be a folder with {METADATA} or CSV files, but got {path}"
        )
    return form


def _field(name: str, topic: str, samples: Samples) -> Field:
    times, values = samples.times, samples.values
    nothing, count = float("nan"), len(values)
    rate = gap = begin = end = nothing
    if times is not None and count:
        begin, end = float(times.min()), float(times.max())
    if times is not None and count > 1:
        rate = (count - 1) / (end - begin) if end > begin else nothing
        gap = float(np.diff(np.sort(times)).max())
    known = np.isfinite(values)
    finite = values[known]
    ends = (float(finite.min()), float(finite.max())) if len(finite) else (nothing, nothing)
    course = np.empty(0)
    if count:
        starts = np.unique(np.linspace(0, count, min(BINS, count), endpoint=False).astype(int))
        with np.errstate(all="ignore"):  # a part without numbers has no mean
            sums = np.add.reduceat(np.where(known, values, 0.0), starts)
            course = sums / np.add.reduceat(known, starts, dtype=int)
    return Field(
        name, topic, count, rate, gap, begin, end, samples.clock, samples.unit, *ends, tuple(course.tolist())
    )


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
        self, wanted: list[MergedWanted], named: Mapping[str, str], units: Mapping[str, str], needs_time: bool
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
    columns: Mapping[str, Column], wanted: Sequence[MergedWanted], known: Mapping[str, str]
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
