"""CSV files with several clocks, as sensor apps of phones write them: a folder or a zip of files, or one file.

Each CSV file of a folder, such as Gyroscope.csv, is a topic by its name. In a file that has several columns of
times and none of all rows, such as gyro_time and acc_time, each begins a topic of the columns behind it.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from zipfile import ZipFile

import numpy as np

from thruster_env.logs.columns import DATE_NAMES, TIME_NAMES, parted
from thruster_env.logs.recorders.topics import Topic, Wanted, check_bytes, reading
from thruster_env.logs.times import in_seconds

KIND, CSV, ZIP, ZIP_MAGIC = "folder of CSV files", ".csv", ".zip", b"PK\x03\x04"
ReadTable = Callable[[Path], Any]
SINCE_START = ("seconds_elapsed", "elapsed")  # of some apps beside dates, more finely
MOST_HEADER = 2**16  # bytes of a first line


def is_folder(path: Path) -> bool:
    """Whether a path is a folder of CSV files."""
    return path.is_dir() and any(_is_member(file.name) for file in path.iterdir())


def has_clocks(path: Path) -> bool:
    """Whether a CSV file has several columns of times and none of all rows."""
    if path.suffix.lower() != CSV or not path.is_file():
        return False
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        first = file.readline(MOST_HEADER)
    headers = [header.strip().strip('"') for header in re.split("[,;\t]", first)]
    return not any(_is_time(header) for header in headers) and sum(map(_begins, headers)) > 1


def topics_of_tables(path: Path, wanted: Wanted = None, *, read: ReadTable) -> Iterator[Topic]:
    """The topics of a folder, a zip or a CSV file with several clocks; columns that are no numbers are not read.

    Args:
        path: of the folder or file.
        wanted: columns that are read; None for all.
        read: `thruster_env.logs.table.read_table`, which knows all formats.

    Raises:
        ValueError: if a file is no table, or has no times; the message names it.
    """
    if path.is_dir():
        yield from _topics_of_folder(path, path, read)
    elif path.suffix.lower() == CSV:
        table = read(path)
        names = list(table.names)
        firsts = [i for i, name in enumerate(names) if _begins(name)]
        for first, end in zip(firsts, [*firsts[1:], len(names)], strict=True):
            yield _topic("", table, names[first], names[first + 1 : end])
    else:
        with TemporaryDirectory() as folder:
            with reading(KIND, path), ZipFile(path) as archive:
                members = [entry for entry in archive.infolist() if _is_member(entry.filename)]
                check_bytes(sum(entry.file_size for entry in members), "a zip of CSV files", path)
                for entry in members:
                    (Path(folder) / entry.filename).write_bytes(archive.read(entry))
                if not members:
                    raise ValueError("it has no CSV file at its top")
            yield from _topics_of_folder(Path(folder), path, read)


def _topics_of_folder(folder: Path, path: Path, read: ReadTable) -> Iterator[Topic]:
    for file in sorted(file for file in folder.iterdir() if _is_member(file.name)):
        try:
            table = read(file)
        except ValueError as error:
            raise ValueError(str(error).replace(str(folder), str(path))) from None
        names = list(table.names)
        time = next((name for name in names if name.lower() in SINCE_START), None)
        time = time or next((name for name in names if _is_time(name)), None)
        clocks = {name for name in names if name == time or _is_time(name) or name.lower() in SINCE_START}
        yield _topic(file.stem, table, time, [name for name in names if name not in clocks])


def _topic(name: str, table: Any, time: str | None, columns: list[str]) -> Topic:
    """The columns of a table by one of its columns of times, in rows that have a time."""
    if time is None:
        return Topic(name, None, {}, unread={"": "no column of times"})
    values, units, unread = dict[str, np.ndarray](), dict[str, str](), dict[str, str]()
    unit = "s" if time.lower() in SINCE_START else parted(time)[1]
    try:
        stamps = table.numbers(time)
    except ValueError as error:
        return Topic(name, None, {}, unread={"": str(error)})
    present = ~np.isnan(stamps)
    seconds, assumption = in_seconds(stamps[present], unit, time, f"column {time!r} of {table.file}")
    for column in columns:
        base, unit = parted(column)
        try:
            values[base] = table.numbers(column)[present]
        except ValueError as error:
            unread[base] = str(error)
        units |= {base: unit} if unit else {}
    return Topic(name, seconds, values, units, unread, " ".join(table.damage), assumption=assumption)


def _is_member(name: str) -> bool:
    return name.lower().endswith(CSV) and not re.search(r"[/\\]", name) and not name.startswith(".")


def _is_time(header: str) -> bool:
    """Whether a header names times of all rows."""
    return parted(header)[0].strip().lower() in {*map(str.lower, TIME_NAMES), *DATE_NAMES}


def _begins(header: str) -> bool:
    """Whether a header names times of the columns behind it, such as gyro_time [s]."""
    words = re.split(r"[^a-z]+", parted(header)[0].strip().lower())
    return len(words) > 1 and words[-1] in ("time", "timestamp", "stamp", "t")
