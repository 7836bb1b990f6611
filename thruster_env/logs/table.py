"""Tables of numbers in files: CSV, Parquet and npz, with errors that name file, line and column."""

from __future__ import annotations

import csv
import io
import math
import os
import re
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from errno import EACCES, EISDIR, ENOENT
from importlib.util import find_spec
from os import PathLike, strerror
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import numpy as np

from thruster_env.core.checks import as_floats, listed, short_repr
from thruster_env.core.modules import to_install
from thruster_env.logs.columns import DATE_NAMES, TIME_NAMES, parted, simple
from thruster_env.logs.findings import Remark
from thruster_env.logs.recorders.topics import Refused, check_bytes, opened
from thruster_env.logs.times import DATE_RULE, MISSING_TEXT, is_clock, is_day, joined, seconds_of, since_first

# What stands for a missing number, in any case of letters.
MISSING = ("", "nan", "na", "n/a", "null", "none", "<na>", "nat")
DELIMITERS = ",;\t"
ZIP_END, ZIP_COUNT = 22, 10  # bytes of a zip's last record, and where in it the number of its files stands
TIME_HEADER = "time_s"  # of an index of times
SUFFIXES = (".csv", ".parquet", ".npz")


@dataclass(frozen=True, eq=False)
class Table:
    """The columns of a file; entries that are not numbers are found when a column is requested.

    Attributes:
        file: its path, for messages.
        cells: of each column by name: texts, or an array.
        lines: of the file in which the rows are, counted from 1.
        line_word: the word for a line.
        clock: rows whose times make the grid, where that are not all (rows,).
        damage: what of the file is not read because it is damaged, in words.
        remarks: findings in the file, by which its rows were made.
    """

    file: str
    cells: Mapping[str, Sequence[str] | np.ndarray]
    lines: Sequence[int]
    line_word: str = "line"
    clock: np.ndarray | None = None
    damage: tuple[str, ...] = ()
    remarks: Sequence[Remark] = ()
    parsed: dict[str, np.ndarray | None] = field(default_factory=dict, init=False, repr=False)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the columns, in order."""
        return tuple(self.cells)

    def location(self, row: int, column: str) -> str:
        """The position of a number, for messages."""
        return f"{self.line_word} {self.lines[row]}, column {column!r} of {self.file}"

    def numbers(self, column: str) -> np.ndarray:
        """A column as float64 (rows,), NaN where a number is missing; ValueError for text and infinite numbers."""
        cells = self.cells[column]
        if isinstance(cells, np.ndarray) and (cells.dtype.kind not in "biufOU" or cells.ndim != 1):
            rule = "columns must hold numbers"
            raise ValueError(f"{rule}, but column {column!r} of {self.file} holds {cells.dtype}")
        if isinstance(cells, np.ndarray) and cells.dtype.kind not in "OU":
            numbers = cells.astype(np.float64)
        else:
            parsed = self._parsed(column)
            if parsed is None:
                texts = _texts(cells)
                row = next(row for row, text in enumerate(texts) if not _is_number(text))
                hint = _hint(texts, row, column)
                is_date = _is_time(column) and not hint.startswith((", with", " below"))
                rule = f"{DATE_RULE}, or numbers" if is_date else f"columns must hold numbers{hint}"
                where = self.location(row, column)
                raise ValueError(f"{rule}, but got {short_repr(cells[row])} in {where}")
            numbers = parsed.copy()
        if np.isinf(numbers).any():
            row = int(np.argmax(np.isinf(numbers)))
            raise ValueError(f"numbers must be finite, but got {numbers[row]} in {self.location(row, column)}")
        return numbers

    def is_text(self, column: str) -> bool:
        """Whether no cell of a column has a digit."""
        cells = self.cells[column]
        if isinstance(cells, np.ndarray) and cells.dtype.kind not in "OU" or self._parsed(column) is not None:
            return False
        return not any(character.isdigit() for character in "".join(_texts(cells)))

    def dates(self, column: str) -> np.ndarray | None:
        """Seconds since the first date of a column, (rows,), NaN for a missing one; None where it has no dates.

        Days and clock times in two columns are one.
        """
        cells = self.cells[column]
        if isinstance(cells, np.ndarray) and cells.dtype.kind not in "mMOU":
            return None
        if isinstance(cells, np.ndarray) and cells.dtype.kind in "mM":
            return since_first(cells)
        if self._parsed(column) is not None:
            return None
        texts = self._with_partner(column, _texts(cells))
        try:
            seconds = seconds_of(texts)
        except ValueError as error:
            raise ValueError(f"{error} in column {column!r} of {self.file}") from None
        if seconds is None:
            return None
        for row, text in enumerate(texts):
            if text != MISSING_TEXT and np.isnan(seconds[row]):
                raise ValueError(f"{DATE_RULE}, but got {short_repr(text)} in {self.location(row, column)}")
        return seconds

    def _with_partner(self, column: str, texts: list[str]) -> list[str]:
        """The texts of a column of days with the clock times of another one, or of clock times with its days."""
        is_of_clock = _are_all(texts, is_clock)
        if not is_of_clock and not (_are_all(texts, is_day) and len(set(texts)) < len(texts)):
            return texts
        for other in self.names:
            if other != column and isinstance(self.cells[other], Sequence | np.ndarray):
                cells = _texts(self.cells[other][:1])
                if _are_all(cells, is_day if is_of_clock else is_clock):
                    cells = _texts(self.cells[other])
                    if _are_all(cells, is_day if is_of_clock else is_clock):
                        return joined(cells, texts) if is_of_clock else joined(texts, cells)
        return texts

    def _parsed(self, column: str) -> np.ndarray | None:
        """The texts of a column as numbers, which is done once; None if some are no numbers."""
        if column not in self.parsed:
            self.parsed[column] = _as_numbers(self.cells[column])
        return self.parsed[column]


def _are_all(texts: Sequence[str], kind: Callable[[str], bool]) -> bool:
    """Whether all texts that are not missing are of a kind, and some are."""
    known = [text for text in texts if text != MISSING_TEXT]
    return bool(known) and all(map(kind, known))


def _as_numbers(cells: Sequence | np.ndarray) -> np.ndarray | None:
    for texts in (cells, None):  # most columns lack nothing
        texts = _texts(cells) if texts is None else texts
        try:
            if _is_written("".join(texts)):
                return np.array(texts, dtype=np.float64)
        except (ValueError, TypeError):
            continue
    return None


def _texts(cells: Sequence | np.ndarray) -> list[str]:
    """Cells as texts, "nan" for what is missing."""
    texts = [str(cell).strip() for cell in cells]
    return [MISSING_TEXT if text.lower() in MISSING else text for text in texts]


def read_table(path: str | Path) -> Table:
    """The table in a file that ends in .csv, .parquet or .npz.

    A CSV file is UTF-8 and begins with a line of names, below comments (#, %) if there are some; commas,
    semicolons, tabs or else spaces part the cells. An empty cell, "nan", "NA" or "null" is a missing number. A
    column without a name, such as an index that pandas writes, is left out. Parquet needs the package pyarrow.

    Args:
        path: of the file.

    Raises:
        ValueError: if the file is wrong; the message names file, line and column.
    """
    if not isinstance(path, (str, PathLike)):
        raise ValueError(f"a log must be the path of a file, but got {short_repr(path)}")
    suffix = Path(path).suffix.lower()
    if suffix not in SUFFIXES:
        from thruster_env.logs.recorders.registry import ENDINGS  # which knows tables

        endings = ", ".join((*SUFFIXES, *ENDINGS))
        rule = f"a log must be a file that ends in {endings}, or a folder of CSV files"
        raise ValueError(f"{rule}, but got {short_repr(str(path))}")
    try:
        return {".csv": _read_csv, ".parquet": _read_parquet, ".npz": _read_npz}[suffix](Path(path))
    except OSError as error:
        raise ValueError(f"a log must be a file that can be read, but {path} is not: {error.strerror}") from None


def _read_csv(path: Path) -> Table:
    check_bytes(path.stat().st_size, "a CSV file", path)
    try:
        text = path.read_text(encoding="utf-8-sig").lstrip("\ufeff")  # some programs write the mark twice
    except UnicodeDecodeError as error:
        line = 1 + error.object[: error.start].count(b"\n")
        rule = "a CSV file must be text in UTF-8"
        raise ValueError(f"{rule}, but {path} is not: {error.reason} in line {line}") from None
    if "\0" in text:  # as in UTF-16, or where a loss of power left a block empty
        line = 1 + text[: text.index("\0")].count("\n")
        raise ValueError(f"a CSV file must be text in UTF-8, but {path} is not: a zero byte in line {line}")
    if not text.strip():
        raise ValueError(f"a log must have a header and rows, but {path} is empty")
    text = _without_comments(text)
    first = text.lstrip().splitlines()[0]
    delimiter = max(DELIMITERS, key=first.count)
    plain = _plain_columns(text, delimiter)
    if plain is not None:
        header, columns = plain
        header[0] = header[0].lstrip("#%").strip()
        _check_header(header, 1, path)
        return _of_texts(path, text, header, columns, range(2, 2 + len(columns[0])))
    if delimiter not in first and len(first.split()) > 1:
        numbered = [(line, row.split()) for line, row in enumerate(text.splitlines(), 1) if row.strip()]
        numbered[0] = (numbered[0][0], first.removeprefix("#").split())
    else:
        reader = csv.reader(io.StringIO(text, newline=""), delimiter=delimiter, skipinitialspace=True)
        try:
            numbered = [(reader.line_num, [*map(str.strip, row)]) for row in reader if any(map(str.strip, row))]
        except csv.Error as error:
            raise ValueError(f"a CSV file must be one, but {path} is not: {error}") from None
    (line, header), *rows = numbered
    header[0] = header[0].lstrip("#%").strip()  # headers are comments to some programs
    _check_header(header, line, path)
    for line, row in rows:
        if len(row) != len(header):
            rule = f"rows must have as many cells as the header, {len(header)}"
            raise ValueError(f"{rule}, but got {len(row)} in line {line} of {path}")
    if not rows:
        raise ValueError(f"a log must have a header and rows, but {path} has only a header")
    columns = [list(column) for column in zip(*(row for _, row in rows), strict=True)]
    return _of_texts(path, text, header, columns, [line for line, _ in rows])


def _without_comments(text: str) -> str:
    """The text with blank lines for comments before the header; the last one is the header if numbers follow."""
    if not text.lstrip().startswith(("#", "%")):
        return text
    lines = text.split("\n")
    for index, line in enumerate(lines[:-1]):
        follower = next((after for after in lines[index + 1 :] if after.strip()), "")
        cells = [cell.strip() for cell in re.split(r"[,;\t ]+", follower.strip()) if cell.strip()]
        is_comment = not line.strip() or line.lstrip().startswith(("#", "%"))
        is_header = not follower.lstrip().startswith(("#", "%")) and any(map(_is_number, cells))
        if not is_comment or is_header or not cells:
            break
        lines[index] = ""
    return "\n".join(lines)


def _plain_columns(text: str, delimiter: str) -> tuple[list[str], list[list[str]]] | None:
    """Header and columns of a text without quotes and blank lines, whose rows have as many cells; None for others.

    It takes a fifth of the time of a reader of CSV.
    """
    if '"' in text or "\r" in text or delimiter not in text:
        return None
    lines = text.removesuffix("\n").split("\n")
    counts = {line.count(delimiter) for line in lines}
    if len(counts) > 1 or len(lines) < 2:
        return None
    width = 1 + counts.pop()
    cells = [*map(str.strip, delimiter.join(lines).split(delimiter))]
    columns = [cells[j::width] for j in range(width)]
    blank = any(not any(column[row] for column in columns) for row, cell in enumerate(columns[0]) if not cell)
    return None if blank else ([column[0] for column in columns], [column[1:] for column in columns])


def _of_texts(
    path: Path, text: str, header: Sequence[str], columns: Sequence[Sequence[str]], lines: Sequence[int]
) -> Table:
    named = {name: cells for name, cells in zip(header, columns, strict=True) if name}
    damage = f"line {lines[-1]} of {path}, the last, has no end, its number the fewest digits: it may be cut"
    is_cut = not text.endswith(("\n", "\r")) and _is_shortest(columns[-1])
    return Table(str(path), named, lines, damage=(damage,) * is_cut)


def _is_shortest(cells: Sequence[str]) -> bool:
    """Whether the last of some numbers has the fewest digits, behind the point where there are points."""
    texts = [cell.lstrip("+-") for cell in cells]
    if any("." in cell for cell in texts):
        texts = [cell.partition(".")[2] for cell in texts]
    *lengths, last = map(len, texts)
    return last < min(lengths, default=0)


def _check_header(header: Sequence[str], line: int, path: Path) -> None:
    if all(map(_is_number, header)):
        rule = "the first line must name the columns"
        raise ValueError(f"{rule}, but line {line} of {path} has numbers: {short_repr(header)}")
    names = set()
    for name in header:
        if name and name in names:
            rule = "names of columns must differ from one another"
            raise ValueError(f"{rule}, but line {line} of {path} has {short_repr(name)} twice")
        names.add(name)


def _read_parquet(path: Path) -> Table:
    if find_spec("pyarrow") is None:
        rule = f"a Parquet file must be read by pyarrow, which is not installed ({to_install('parquet')})"
        raise ValueError(f"{rule}, but got {path}")
    if not path.exists():
        raise FileNotFoundError(ENOENT, strerror(ENOENT))
    with _damaged("a Parquet file must be one, but {path} is not", path), opened("parquet", path) as file:
        check_bytes(max(8 * file.contents["numbers"], file.contents["bytes"]), "what a Parquet file holds", path)
        names = [str(name) for name in file.contents["names"]]
        _check_header(names, 1, path)
        cells = {name: file.read(number) for number, name in enumerate(names)}
    return _of_arrays(path, cells)


def _read_npz(path: Path) -> Table:
    with _damaged("an npz file must hold arrays of numbers by name, but {path} does not", path):
        cells = dict(_arrays(path))
    return _of_arrays(path, cells)


def _arrays(path: Path) -> Iterator[tuple[str, np.ndarray]]:
    """Names and arrays of an npz file, whose sizes are read before what is in them."""
    total = 0
    with ZipFile(path) as archive, path.open("rb") as file:
        file.seek(-ZIP_END - len(archive.comment), os.SEEK_END)
        (count,) = struct.unpack_from("<H", file.read(ZIP_END), ZIP_COUNT)
        if count not in (len(archive.infolist()), 2**16 - 1):  # the package goes by the sizes alone
            raise ValueError(f"it says that it has {count} arrays, but lists {len(archive.infolist())}")
        for entry in archive.infolist():
            with archive.open(entry) as member:
                version = np.lib.format.read_magic(member)
                read_header = np.lib.format.read_array_header_1_0
                read_header = np.lib.format.read_array_header_2_0 if version == (2, 0) else read_header
                shape, _, dtype = read_header(member)
                total += math.prod(shape) * max(dtype.itemsize, 8)
                check_bytes(total, "what an npz file holds", path)
                if min(shape, default=0) < 0 or math.prod(shape) * dtype.itemsize > entry.file_size:
                    raise ValueError(f"{entry.filename!r} ends within its array")
            with archive.open(entry) as member:
                values = np.lib.format.read_array(member, allow_pickle=False)
                if member.read(1):  # of another shape or type than is stated; the check sum is at the end
                    raise ValueError(f"{entry.filename!r} holds more than its array")
                yield entry.filename.removesuffix(".npy"), values


@contextmanager
def _damaged(rule: str, path: Path) -> Iterator[None]:
    """Make one line of whatever is raised for bytes that are not as they should be, but not for a missing file."""
    try:
        yield
    except Refused:
        raise
    except Exception as error:
        if isinstance(error, OSError) and error.strerror and error.errno in (ENOENT, EACCES, EISDIR):
            raise
        why = " ".join(str(error).split())[:200] or type(error).__name__
        raise ValueError(f"{rule.format(path=path)}: {why}") from None


def table_of(columns: Any, name: str) -> Table:
    """A table that is in memory: a mapping from headers to arrays (rows,), or a pandas.DataFrame.

    An index of times (`times_of_index`) is a column of seconds, and another one that has a name is a column.

    Raises:
        ValueError: if it is neither, or its columns are not of equal length.
    """
    if hasattr(columns, "columns") and hasattr(columns, "index"):
        columns = _with_index(columns)
    if not isinstance(columns, Mapping) or not all(isinstance(header, str) for header in columns):
        rule = "a log must be the path of a file, a pandas.DataFrame, a mapping from headers to arrays, or a Log"
        raise ValueError(f"{rule}, but got {short_repr(columns)}")
    return _of_arrays(name, {header: _unmasked(values) for header, values in columns.items()})


def _unmasked(values: Any) -> np.ndarray:
    return as_floats(values) if hasattr(values, "filled") else np.asarray(values)


def _with_index(frame: Any) -> dict:
    """The columns of a DataFrame as arrays, and its index where that tells something."""
    columns = {header: frame[header].to_numpy() for header in frame.columns}
    index = frame.index
    is_plain = getattr(index.dtype, "kind", "") not in "mM" and not hasattr(index, "to_timestamp")
    if is_plain and (_is_time(index.name) or any(map(_is_time, columns))):
        return columns if index.name is None else {index.name: index.to_numpy(), **columns}
    times = times_of_index(index)
    if times is not None:
        return {TIME_HEADER: times, **columns}
    return columns if index.name is None else {index.name: index.to_numpy(), **columns}


def _is_time(header: Any) -> bool:
    """Whether a header names times, with or without a unit."""
    return isinstance(header, str) and parted(header)[0].strip().lower() in (*TIME_NAMES, *DATE_NAMES)


def times_of_index(index: Any) -> np.ndarray | None:
    """Times of the rows of a pandas index [s], (rows,); None where it only counts them or names them.

    Times are dates, also as texts and as periods, which count from their beginnings, time differences, and
    floats that increase, unless they are 0, 1, 2 and so on or their name has another unit than of time.
    """
    if not len(index):
        return None
    if hasattr(index, "to_timestamp"):
        index = index.to_timestamp()
    kind = getattr(index.dtype, "kind", "O")
    if kind in "mM":
        return (index - index[0]).total_seconds().to_numpy()
    if kind == "f":
        unit = parted(index.name)[1] if isinstance(index.name, str) else None
        base, scale = simple(unit) if unit else ("s", 1.0)
        times = scale * index.to_numpy().astype(np.float64)
        if base != "s":
            return None
        is_count = np.array_equal(times, np.arange(len(times)))
        return None if is_count or len(times) < 2 or not (np.diff(times) > 0.0).all() else times
    if kind in "OUT" and isinstance(index[0], str):
        texts = Table("an index", {"index": [*map(str, index)]}, range(1, len(index) + 1), "row")
        return texts.dates("index")
    return None


def refuse_holes(index: Any) -> None:
    """Raise ValueError for a pandas index of numbers that has holes, as after `dropna`, or does not increase.

    Floats of another unit than of time are not checked.
    """
    kind, unit = getattr(index.dtype, "kind", "O"), parted(str(index.name or ""))[1]
    if kind not in "iuf" or (kind == "f" and unit and simple(unit)[0] != "s"):
        return
    steps = np.diff(index.to_numpy())
    if not (steps > 0).all():
        row = int(np.argmin(steps > 0)) + 1
        rule = f"an index of numbers must increase, but {index[row]} follows {index[row - 1]}"
        raise ValueError(f"{rule}: z.sort_index() puts rows in order, z.to_numpy() leaves the index out")
    if kind != "f" and len(set(steps.tolist())) > 1:
        row = int(np.argmax(steps != steps.min())) + 1
        rule = "rows of an index of whole numbers must be equal steps"
        way = "z.reindex(range(first, last + 1)) puts NaN in missing rows, z.to_numpy() leaves the index out"
        raise ValueError(f"{rule}, but {index[row]} follows {index[row - 1]}: {way}")


def refuse_swapped(name: str, table: Any, quantities: Sequence) -> None:
    """Raise ValueError for a pandas table whose columns are those of the model in another order."""
    symbols, headers = [quantity.symbol for quantity in quantities], map(str, getattr(table, "columns", ()))
    columns = [header if header in symbols else parted(header)[0] for header in headers]
    if columns != symbols and sorted(columns) == sorted(symbols):
        rule = f"columns of {name} must be in the order of the model, {', '.join(symbols)}"
        raise ValueError(f"{rule}, but got {', '.join(columns)}: table[[{', '.join(map(repr, symbols))}]] has it")


def _of_arrays(path: Path | str, cells: dict[str, np.ndarray]) -> Table:
    rule = "a log must have columns of equal length with some rows"
    first = next((name for name, column in cells.items() if column.ndim == 1 and len(column)), None)
    if first is None:
        raise ValueError(f"{rule}, but {path} has {listed(cells) or 'none'}")
    for name, column in cells.items():
        if column.shape != cells[first].shape:
            sizes = (
                f"{short_repr(name)} of shape {column.shape} beside {short_repr(first)} of {cells[first].shape}"
            )
            raise ValueError(f"{rule}, but {path} has {sizes}: leave one out")
    return Table(str(path), cells, range(1, len(cells[first]) + 1), "row")


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return _is_written(text)


def _hint(texts: Sequence[str], row: int, column: str) -> str:
    """What would make a number of a text in a column, behind "columns must hold numbers"; empty if unknown."""
    text = texts[row]
    if text.count(",") == 1 and _is_number(text.replace(",", ".")):
        return ", with decimal points"
    if _is_number(text.replace(",", "")) or _is_number(text.replace(".", "").replace(",", ".")):
        return " without separators of thousands"
    number = text.strip("".join(set(text) - set("+-.0123456789")))
    if _is_number(number):
        unit = text.replace(number, "").strip()
        return f" alone, with their unit in the header, as {parted(column)[0]} [{unit}]"
    if row == 0 and len(texts) > 1 and _is_number(texts[1]):
        return f" below the header, which has their unit, as {parted(column)[0]} [{text}]"
    return ""


def _is_written(text: str) -> bool:
    """Whether a text that Python takes for a number is one in other languages: no "1_0", and digits of ASCII."""
    return "_" not in text and text.isascii()
