"""Recorders' files by their ending and first bytes: their fields, and the samples of chosen fields."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from thruster_env.core.checks import one_of
from thruster_env.logs.columns import TIME, find_columns, parted
from thruster_env.logs.grid import in_seconds
from thruster_env.logs.recorders import bag_counts, bags, dataflash, hdf5, matlab, ulog
from thruster_env.logs.recorders.bag_counts import METADATA
from thruster_env.logs.recorders.one_clock import RECEIPT, STAMPS, Clocked, chosen_clock
from thruster_env.logs.recorders.topics import Reader, Topic, Wanted, unreadable
from thruster_env.logs.table import SUFFIXES, Table, read_table

BINS = 8  # of the course of a field


class Format(NamedTuple):
    """A format of recorders' files."""

    kind: str  # its name in messages
    endings: tuple[str, ...]
    magic: bytes  # the first bytes of a file
    topics: Reader
    has_stamps: bool = True  # whether each topic has times of its own, whatever its fields are called
    has_units: bool = True  # whether units are in the file, and not only known of its messages
    has_receipt: bool = False  # whether messages have times of reception beside those of headers


FORMATS = (
    Format(ulog.KIND, (".ulg", ".ulog"), ulog.MAGIC, ulog.topics, has_units=False),
    Format(dataflash.KIND, (".bin",), dataflash.MAGIC, dataflash.topics),
    Format("bag of ROS 1", (".bag",), bag_counts.ROS1, bags.topics, has_receipt=True),
    Format("MCAP file", (".mcap",), bag_counts.MCAP, bags.topics, has_receipt=True),
    Format("bag of ROS 2", (".db3",), bag_counts.DB3, bags.topics, has_receipt=True),
    Format(matlab.KIND, (".mat",), matlab.MAGIC, matlab.topics, False),
    Format(hdf5.KIND, (".h5", ".hdf5", ".hdf"), hdf5.MAGIC, hdf5.topics, False),
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
            `thruster_env.logs.recorders.one_clock`; of topics without stamps in headers always "receipt".
            By default that of headers if all topics have stamps of one clock.

    Raises:
        ValueError: if it is no recorder's file and no table, or is damaged; the message is one line.
    """
    if Path(path).suffix.lower() in SUFFIXES:
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
        raise ValueError(f"a recorder's file must end in {kinds} or be a folder with {METADATA}, but got {path}")
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
