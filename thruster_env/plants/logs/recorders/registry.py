"""Recorders' files by their ending and first bytes: what is in them, and samples of what is wanted."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import NamedTuple

import numpy as np

from thruster_env.plants.logs.columns import TIME, find_columns
from thruster_env.plants.logs.recorders import bag_counts, bags, dataflash, hdf5, matlab, ulog
from thruster_env.plants.logs.recorders.bag_files import METADATA
from thruster_env.plants.logs.recorders.topics import Reader, Wanted, unreadable
from thruster_env.plants.logs.table import SUFFIXES, Table, read_table
from thruster_env.plants.logs.units import converted, parted

BINS = 8  # of the course of a field


class Format(NamedTuple):
    """A format of recorders' files."""

    kind: str  # its name in messages
    endings: tuple[str, ...]
    magic: bytes  # the first bytes of a file
    topics: Reader
    has_stamps: bool = True  # whether each topic has times of its own, whatever its fields are called


FORMATS = (
    Format(ulog.KIND, (".ulg", ".ulog"), ulog.MAGIC, ulog.topics),
    Format(dataflash.KIND, (".bin",), dataflash.MAGIC, dataflash.topics),
    Format("bag of ROS 1", (".bag",), bag_counts.ROS1, bags.topics),
    Format("MCAP file", (".mcap",), bag_counts.MCAP, bags.topics),
    Format("bag of ROS 2", (".db3",), bag_counts.DB3, bags.topics),
    Format(matlab.KIND, (".mat",), matlab.MAGIC, matlab.topics, False),
    Format(hdf5.KIND, (".h5", ".hdf5", ".hdf"), hdf5.MAGIC, hdf5.topics, False),
)
ENDINGS = tuple(ending for one in FORMATS for ending in one.endings)


class Samples(NamedTuple):
    """A field's samples by their own times."""

    times: np.ndarray | None  # (samples,) [s]; None where the file has none for it
    values: np.ndarray  # (samples,)
    unit: str  # empty where the file has none
    damage: str = ""  # what of the file is not read because it is damaged, in words


class Field(NamedTuple):
    """What there is of a field; NaN where there are no times or no finite numbers."""

    name: str  # of its column, TOPIC.FIELD
    topic: str  # empty for an array that stands alone
    samples: int
    rate: float  # [Hz], over the whole field
    gap: float  # [s], the longest between two samples
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
    named = next((one for one in FORMATS if path.suffix.lower() in one.endings), None)
    if (path / METADATA).is_file():
        return next(one for one in FORMATS if ".db3" in one.endings)
    if path.is_dir() and named is not None:
        raise unreadable(named.kind, path, "it is a folder")
    if named is None and (path.suffix.lower() in SUFFIXES or not path.is_file()):
        return None
    try:
        with path.open("rb") as file:
            first = file.read(max(len(one.magic) for one in FORMATS))
    except OSError as error:
        raise ValueError(f"a log must be a file that can be read, but {path} is not: {error.strerror}") from None
    begun = next((one for one in FORMATS if first.startswith(one.magic)), None)
    if named is not None and begun is not named:
        why = "it is empty" if not first else f"it begins with {first[:8]!r}"
        raise unreadable(named.kind, path, why if begun is None else f"it is a {begun.kind}")
    return begun


def contents(path: str | Path) -> Contents:
    """All fields of a recorder's file or a table that hold numbers, and what of it is not read.

    Args:
        path: of the file.

    Raises:
        ValueError: if it is no recorder's file and no table, or is damaged; the message is one line.
    """
    if Path(path).suffix.lower() in SUFFIXES:
        return _of_table(read_table(path))
    found, unread, damage = list[Field](), dict[str, str](), dict[str, None]()
    for topic in _known(path).topics(Path(path), None):
        found += [
            _field(topic.column(name), topic.name, topic.times, values, topic.units.get(name, ""))
            for name, values in topic.values.items()
        ]
        unread |= {topic.column(name) if name else topic.name: why for name, why in topic.unread.items()}
        damage |= {topic.damage: None} if topic.damage else {}
    return Contents(found, unread, tuple(damage))


def _of_table(table: Table) -> Contents:
    """The columns of a table, with the rate of its times, where it has some."""
    clock, times = find_columns([], table.names, {}, {}, table.file).get(TIME), None
    if clock is not None:
        try:
            dates = table.dates(clock.header)
            where = f"column {clock.header!r} of {table.file}"
            times = converted(table.numbers(clock.header), clock.unit, "s", where) if dates is None else dates
        except ValueError:  # the column is listed, or why it is not
            times = None
    found, unread = list[Field](), dict[str, str]()
    for name in table.names:
        try:
            values = table.numbers(name)
        except ValueError as error:
            unread[name] = "dates" if clock and name == clock.header and times is not None else str(error)
        else:
            there = ~np.isnan(values) & (True if times is None else ~np.isnan(times))
            own = times[there] if times is not None else None
            found.append(_field(name, "", own, values[there], parted(name)[1] or ""))
    return Contents(found, unread, ())


def fields(path: str | Path) -> list[Field]:
    """All fields of a recorder's file that hold numbers, in order of topics; raises as `contents`."""
    _known(path)
    return contents(path).fields


def read(path: str | Path, names: Collection[str] | None) -> dict[str, Samples]:
    """The samples of some fields that a file has, by name, None for all; what it does not have is left out.

    Args:
        path: of the file.
        names: of columns, TOPIC.FIELD.

    Raises:
        ValueError: as `contents`.
    """
    wanted: Wanted = None if names is None else frozenset(names)
    return {
        topic.column(name): Samples(topic.times, values, topic.units.get(name, ""), topic.damage)
        for topic in _known(path).topics(Path(path), wanted)
        for name, values in topic.values.items()
        if wanted is None or topic.column(name) in wanted
    }


def _known(path: str | Path) -> Format:
    found = format_of(path)
    if found is None:
        kinds = ", ".join(ENDINGS)
        raise ValueError(f"a recorder's file must end in {kinds} or be a folder with {METADATA}, but got {path}")
    return found


def _field(name: str, topic: str, times: np.ndarray | None, values: np.ndarray, unit: str) -> Field:
    nothing, count = float("nan"), len(values)
    rate = gap = nothing
    if times is not None and count > 1:
        length = float(times.max() - times.min())
        rate = (count - 1) / length if length > 0.0 else nothing
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
    return Field(name, topic, count, rate, gap, unit, *ends, tuple(course.tolist()))
