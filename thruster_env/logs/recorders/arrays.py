"""Arrays of numbers beside a vector of times, in HDF5 and MATLAB files.

HDF5 and MATLAB's version 7.3 are read by the package h5py in a process of its own. Versions 5 to 7 are read here:
SciPy's reader crashes on damaged ones.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from thruster_env.logs.columns import TIME_NAMES, parted
from thruster_env.logs.recorders.topics import (
    MOST_COLUMNS,
    MOST_FIELDS,
    Format,
    Opened,
    Refused,
    Topic,
    Wanted,
    check_bytes,
    columns_of,
    opened,
    package,
    reading,
)
from thruster_env.logs.times import in_seconds

NUMERIC = "biuf"  # NumPy's kinds
FEWEST = 2  # samples; what has fewer is a constant

# Of files.
HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"
UNITS, SCALE, OFFSET = ("units", "unit"), "scale_factor", "add_offset"  # attributes
MISSING = ("_fillvalue", "missing_value")
LEAST, GREATEST, RANGE = "valid_min", "valid_max", "valid_range"
UNSIGNED = "_unsigned"


def topics_of(
    arrays: Mapping[str, Any],
    path: Path,
    wanted: Wanted = None,
    unit: Callable[[Any], Sequence[str]] = lambda array: (),
) -> Iterator[Topic]:
    """The channels among arrays: a vector, or a matrix whose columns are channels NAME[0], NAME[1] and so on.

    Times are the vector `time` (or t, time_ms and the like) beside an array, or else in a group around it, if it
    is as long as the array; of a matrix, times may run along either side.

    Args:
        arrays: by "GROUP.NAME", with shape and dtype, read by `[...]`; or the text why an array is refused.
        path: of the file, for messages.
        wanted: columns that are read; None for all.
        unit: of an array, or one for each of its columns; empty where it has none.

    Raises:
        ValueError: if an array is wanted that is refused, or too large.
    """
    sizes = {name: _size(array) for name, array in arrays.items()}
    vectors: dict[str, dict[str, int]] = {}  # of times, their lengths by group and name
    for name, size in sizes.items():
        if size is not None and size[1] == 1 and parted(name.rpartition(".")[2])[0] in TIME_NAMES:
            vectors.setdefault(name.rpartition(".")[0], {})[name] = size[0]
    known: dict[str, tuple[np.ndarray | None, str]] = {}
    if wanted is None:
        within = {name[:end] for name in arrays for end, letter in enumerate(name) if letter in "({"}
        refused = {name: why for name, array in arrays.items() if (why := _why_not(array)) and name not in within}
        yield from [Topic("", None, {}, unread=refused)] if refused else []
    for name, array in arrays.items():
        if wanted is not None and not any(each == name or each.startswith(f"{name}[") for each in wanted):
            continue
        if why := _why_not(array):
            if wanted is not None:
                raise Refused(f"a field must be an array of numbers, but {name!r} is {why} ({path})")
            continue
        if sizes[name] is None:
            continue
        clock, along = next(
            (each for each in _clocks(name, vectors) if each[1] in array.shape), (None, max(array.shape))
        )
        if math.prod(array.shape) > MOST_COLUMNS * along:
            continue
        group, _, field = name.rpartition(".")
        try:
            values = _read(name, array, path)
            if clock is not None and clock not in known:
                known = {clock: _times(clock, arrays[clock], path, unit)}
        except Refused:
            raise
        except Exception as error:  # of this one alone
            why = " ".join(str(error).split())[:160] or type(error).__name__
            if wanted is not None:
                rule = "a field must be one that can be read"
                raise Refused(f"{rule}, but {name!r} is not: {why} ({path})") from None
            yield Topic("", None, {}, unread={name: f"damaged: {why}"})
            continue
        values = values if values.shape[0] == along else values.T
        fields = columns_of(field, values)
        times, clock_remark = known[clock] if clock is not None else (None, "")
        yield Topic(group, times, fields, _units(unit(array), [*fields]), assumption=clock_remark)


def _units(texts: Sequence[str], fields: Sequence[str]) -> dict[str, str]:
    """The units of fields: one for all or one for each; any other number is joined to a text that is no unit."""
    each = texts if len(texts) == len(fields) else [", ".join(texts)] * len(fields)
    return {field: text for field, text in zip(fields, each, strict=True) if text}


def _times(
    clock: str, vector: Any, path: Path, unit: Callable[[Any], Sequence[str]]
) -> tuple[np.ndarray | None, str]:
    """The times in a vector [s], None for those of an unknown unit; and how they were read, in words."""
    try:
        times = _read(clock, vector, path).astype(np.float64)
        return in_seconds(times, ", ".join(unit(vector)) or parted(clock)[1], clock, f"{clock!r} of {path}")
    except Refused:
        raise
    except ValueError:
        return None, ""


def _why_not(array: Any) -> str:
    """Why an array is not read, empty if it may be."""
    if isinstance(array, str):
        return array
    if array.dtype.kind not in NUMERIC:
        return getattr(array, "what", f"of {array.dtype}")
    sides = _sides(array)
    if len(sides) > 2:
        return f"of {len(sides)} dimensions"
    return (
        f"a matrix of {sides[0]} times {sides[1]}" if min(sides[1:], default=0) > MOST_COLUMNS < sides[0] else ""
    )


def _sides(array: Any) -> list[int]:
    """The sides of an array of more than one entry; Simulink writes signals as 1 x 1 x samples."""
    return [side for side in array.shape if side != 1]


def _size(array: Any) -> tuple[int, int] | None:
    """The longer and the shorter side of a vector or matrix of numbers, None for anything else."""
    if _why_not(array) or 0 in array.shape or not (sides := _sides(array)):
        return None
    return max(sides), min(sides) if len(sides) == 2 else 1


def _clocks(name: str, vectors: Mapping[str, Mapping[str, int]]) -> Iterator[tuple[str, int]]:
    """Vectors of times that may be those of an array, and their lengths: beside it, then in groups around it."""
    group = name
    while group:
        group = group.rpartition(".")[0]
        yield from vectors.get(group, {}).items()


def _read(name: str, array: Any, path: Path) -> np.ndarray:
    """An array without its dimensions of length one."""
    check_bytes(math.prod(array.shape) * max(array.dtype.itemsize, 8), f"the array {name!r}", path)
    return np.squeeze(np.asarray(array[...]))


def hdf5_topics(path: Path, wanted: Wanted = None) -> Iterator[Topic]:
    """The numeric arrays of one or two dimensions, by group: GROUP.GROUP.DATASET; see `topics_of`.

    A unit is the attribute `units` or `unit` of a dataset, in any case, a text or an array of one, or of one for
    each column of a matrix. Numbers are
    `scale_factor` times what is stored plus `add_offset`, NaN where that is `_FillValue` or `missing_value` or
    outside `valid_range`, or `valid_min` and `valid_max`; whole numbers have no sign if `_Unsigned` says so. Of
    MATLAB's version 7.3, arrays of structures and cells are STRUCT(1).FIELD and CELL{1}. No link is followed,
    neither within the file nor to another one, and no object or text is read; a dataset whose numbers lie in other
    files is none. A process of its own reads the file, since the library breaks off at some that are damaged.

    Args:
        path: of the file.
        wanted: columns that are read, and times; None for all.

    Raises:
        ValueError: if it is no HDF5 file, or its arrays are larger than may be read.

    Source: "NetCDF Climate and Forecast (CF) Metadata Conventions", 1.11, sections 2.5.1 and 8.1.
    """
    if find_spec("h5py") is None:
        package("h5py", HDF5.kind, path)  # which says how to install it
    with reading(HDF5.kind, path), opened("hdf5", path) as file:
        datasets = {
            name: description if isinstance(description, str) else Dataset(file, number, description)
            for number, (name, description) in enumerate(file.contents["datasets"].items())
        }
        yield from topics_of(datasets, path, wanted, _unit)


HDF5 = Format("HDF5 file", (".h5", ".hdf5", ".hdf"), HDF5_MAGIC, hdf5_topics, has_stamps=False)


class Dataset:
    """A dataset in a file that another process reads."""

    def __init__(self, file: Opened, number: int, description: Mapping[str, Any]):
        self._file, self._number = file, number
        self.shape = tuple(int(side) for side in description["shape"])
        self.dtype = np.dtype(description["dtype"] if description["kind"] in NUMERIC else object)
        self.what = f"of {description['dtype']}"
        self.attributes = {key.lower(): value for key, value in description["attributes"].items()}

    def __getitem__(self, key: Any) -> np.ndarray:
        """Read all of it, in its unit."""
        stored = self._file.read(self._number)
        is_unsigned = stored.dtype.kind == "i" and str(self.attributes.get(UNSIGNED)).lower() == "true"
        stored = stored.view(stored.dtype.str.replace("i", "u")) if is_unsigned else stored
        scale, offset, least, greatest = (self._number_of(name) for name in (SCALE, OFFSET, LEAST, GREATEST))
        absent = [marker for name in MISSING for marker in self._numbers_of(name)]
        if RANGE in self.attributes:
            least, greatest = self._numbers_of(RANGE)
        if is_unsigned:  # the numbers of attributes have the type of what is stored
            absent = [marker % 256**stored.itemsize for marker in absent]
        if all(number is None for number in (scale, offset, least, greatest)) and not absent:
            return stored
        values = stored.astype(np.float64) * (1.0 if scale is None else scale) + (offset or 0.0)
        for marker in absent:
            values[stored == marker] = np.nan
        values[stored < (-np.inf if least is None else least)] = np.nan
        values[stored > (np.inf if greatest is None else greatest)] = np.nan
        return values

    def _number_of(self, name: str) -> float | int | None:
        """An attribute that is a number, or an array of one; None for none."""
        numbers = self._numbers_of(name)
        if len(numbers) > 1:
            raise ValueError(f"the attribute {name}={numbers} is no number")
        return numbers[0] if numbers else None

    def _numbers_of(self, name: str) -> list[float | int]:
        value = self.attributes.get(name, [])
        numbers = value if isinstance(value, list) else [value]
        if not all(isinstance(number, int | float) for number in numbers):
            raise ValueError(f"the attribute {name}={value!r} is no number")
        return numbers


def _unit(dataset: Dataset) -> list[str]:
    """The units in a dataset's attributes; "seconds" of "seconds since 2026-05-01" (CF conventions)."""
    for name in UNITS:
        value = dataset.attributes.get(name)
        texts = np.ravel(np.array(value, object)).tolist()
        if value is not None and all(isinstance(text, str) for text in texts):
            return [text.partition(" since ")[0].strip() for text in texts]
    return []


HEADER = 128  # bytes of a file
MATRIX, COMPRESSED = 14, 15  # types of elements
INT8, INT32, UINT32, UTF8 = 1, 5, 6, 16
NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}  # by type
TEXTS = (16, 17, 18)
CELL, STRUCTURE, NUMERIC_CLASSES, OPAQUE = 1, 2, range(6, 16), 17  # classes of arrays
OTHERS = {
    CELL: "a cell array",
    STRUCTURE: "an array of structures",
    4: "text",
    5: "a sparse matrix",
    16: "a function",
}
COMPLEX = 0x0800  # among the flags
MOST_SIDES = 32
DEEPEST = 32
TAG = 8  # bytes of type and size before an element
PIECE = 2**20  # bytes
WHOLE = "what a MATLAB file holds"
MATLAB_MAGIC = b"MATLAB "
VERSION_7_3 = b"MATLAB 7.3"


def arrays_of(path: Path) -> dict[str, Any]:
    """Arrays by "STRUCTURE.FIELD", "STRUCTURES(2).FIELD" or "CELL{2}", or a text that says why one is not read.

    MATLAB counts the entries of arrays of structures and of cells from 1, along their columns.

    Raises:
        ValueError: for a file that is cut off, damaged, or unpacks to more than may be read.

    Source: MathWorks, "MAT-File Format", level 5.
    """
    arrays: dict[str, Any] = {}
    size, total = path.stat().st_size, 0
    with path.open("rb") as file:
        order = {b"IM": "<", b"MI": ">"}.get(file.read(HEADER)[HEADER - 2 :])
        if order is None:
            raise ValueError("its header has no order of bytes")
        while len(tag := file.read(8)) == 8:
            kind, count = struct.unpack(f"{order}II", tag)
            if file.tell() + count > size:
                raise ValueError("it ends within an array")
            if kind == COMPRESSED:
                data = _unpacked(file, count, order, total, path)
            else:
                check_bytes(total + count, WHOLE, path)
                data = bytearray(tag + file.read(count))
            total += len(data)
            for element in _elements(data, 0, len(data), order):
                _add(data, element, order, "", arrays, path)
    if tag:
        raise ValueError("it ends within an array")
    return arrays


def _unpacked(file: BinaryIO, count: int, order: str, total: int, path: Path) -> bytearray:
    """Unpack an element, to the size in its first bytes; `total` is the size of the elements before it [bytes]."""
    packed, filled = zlib.decompressobj(), 0
    out = bytearray(TAG)
    end = file.tell() + count
    piece = b""
    while filled < len(out) and (piece or file.tell() < end):
        piece = piece or file.read(min(end - file.tell(), PIECE))
        data = packed.decompress(piece, min(len(out) - filled, PIECE))
        piece = packed.unconsumed_tail
        out[filled : filled + len(data)] = data
        filled += len(data)
        if filled == TAG == len(out):
            size = struct.unpack(f"{order}II", out)[1]
            check_bytes(total + TAG + size, WHOLE, path)
            out += bytes(size)
        if packed.eof or not (data or piece or file.tell() < end):
            break
    if packed.decompress(piece + file.read(end - file.tell()), 1) or not packed.eof:  # the check sum is at its end
        raise ValueError("it holds an array that is packed and damaged")
    file.seek(end)
    del out[filled:]
    return out


def _elements(data: bytes | bytearray, begin: int, end: int, order: str) -> list[tuple[int, int, int]]:
    """Type, place and bytes of the elements that follow one another; ValueError unless they are sound."""
    parts, offset = [], begin
    while offset < end:
        if offset + 8 > end:
            raise ValueError("it ends within an element")
        kind, count = struct.unpack_from(f"{order}II", data, offset)
        at, after = offset + 8, offset + 8 + count + (-count) % 8
        if kind >> 16:  # up to four bytes within the tag
            kind, count, at, after = kind & 0xFFFF, kind >> 16, offset + 4, offset + 8
        if kind not in (*NUMBERS, MATRIX, *TEXTS) or at + count > min(end, after):
            raise ValueError("it holds a damaged element")
        parts.append((kind, at, count))
        offset = after
    return parts


def _add(
    data: bytes | bytearray,
    element: tuple[int, int, int],
    order: str,
    name: str,
    arrays: dict[str, Any],
    path: Path,
) -> None:
    """Add an array by its name or its field's, or the fields of a structure."""
    kind, begin, count = element
    if kind != MATRIX or sum(map(name.count, ".{(")) > DEEPEST:
        raise ValueError("it holds a damaged array")
    if not count:
        return
    parts = _elements(data, begin, begin + count, order)
    if len(parts) < 3 or parts[0][0] != UINT32 or parts[0][2] != 8:
        raise ValueError("it holds a damaged array")
    flags = struct.unpack_from(f"{order}I", data, parts[0][1])[0]
    of = flags & 0xFF
    if not 0 < of <= OPAQUE:
        raise ValueError("it holds an array of no known class")
    if of == OPAQUE:  # whose name stands elsewhere
        return
    if (
        parts[1][0] not in (INT32, UINT32)
        or parts[2][0] not in (INT8, UTF8)
        or parts[1][2] % 4
        or not 8 <= parts[1][2] <= 4 * MOST_SIDES
    ):
        raise ValueError("it holds a damaged array")
    sides = struct.unpack_from(f"{order}{parts[1][2] // 4}i", data, parts[1][1])
    name = name or _text(data, parts[2])
    if len(arrays) > MOST_FIELDS:
        raise ValueError(f"it has more than {MOST_FIELDS} arrays")
    if of == STRUCTURE and sides == (1, 1):
        _add_fields(data, parts, order, name, arrays, path)
    elif of in (CELL, STRUCTURE) and 0 < math.prod(sides) <= MOST_FIELDS and min(sides) > 0:
        arrays[name] = OTHERS[of]
        if of == STRUCTURE:
            _add_fields(data, parts, order, name, arrays, path, math.prod(sides))
        else:
            for index, cell in enumerate(parts[3:], 1):
                _add(data, cell, order, f"{name}{{{index}}}", arrays, path)
    elif of not in NUMERIC_CLASSES or flags & COMPLEX:
        arrays[name] = OTHERS.get(of, "of complex numbers" if of in NUMERIC_CLASSES else "an object of MATLAB's")
    else:
        check_bytes(8 * math.prod(sides), f"the array {name!r}", path)
        arrays[name] = _numbers(data, parts, order, sides)


def _add_fields(
    data: bytes | bytearray,
    parts: list,
    order: str,
    name: str,
    arrays: dict[str, Any],
    path: Path,
    count: int | None = None,
) -> None:
    """Add the fields of a structure, or those of each of an array of so many structures."""
    if len(parts) < 5 or parts[3][0] != INT32 or parts[3][2] != 4 or parts[4][0] != INT8:
        raise ValueError("it holds a damaged structure")
    (length,) = struct.unpack_from(f"{order}i", data, parts[3][1])
    _, at, size = parts[4]
    if length < 1 or size % length or size // length * (count or 1) != len(parts[5:]):
        raise ValueError("it holds a damaged structure")
    fields = [_text(data, (INT8, at + start, length)) for start in range(0, size, length)]
    for index, element in enumerate(parts[5:]):
        number, field = divmod(index, len(fields))
        whose = name if count is None else f"{name}({number + 1})"
        _add(data, element, order, f"{whose}.{fields[field]}", arrays, path)


def _numbers(data: bytes | bytearray, parts: list, order: str, sides: tuple[int, ...]) -> np.ndarray:
    """Numbers of an array, whose columns follow one another."""
    kind, at, count = parts[3] if len(parts) == 4 else (0, 0, 0)
    if kind not in NUMBERS or math.prod(sides) * np.dtype(NUMBERS[kind]).itemsize != count or min(sides) < 0:
        raise ValueError("it holds an array whose numbers are none")
    stored = np.dtype(f"{order}{NUMBERS[kind]}")
    return np.frombuffer(data, stored, math.prod(sides), at).reshape(sides, order="F")


def _text(data: bytes | bytearray, part: tuple[int, int, int]) -> str:
    _, at, count = part
    return data[at : at + count].partition(b"\0")[0].decode("latin-1")


def matlab_topics(path: Path, wanted: Wanted = None) -> Iterator[Topic]:
    """The numeric arrays of one or two dimensions, by structure: STRUCT.FIELD; see `topics_of`.

    Objects, functions, cells and text are not read. A MATLAB file has no units.

    Args:
        path: of the file, version 5 or later.
        wanted: columns that are read; None for all.

    Raises:
        ValueError: if it is no MATLAB file, or its arrays are larger than may be read.

    Source: MathWorks, "MAT-File Format".
    """
    with path.open("rb") as file:
        if file.read(len(VERSION_7_3)) == VERSION_7_3:
            yield from hdf5_topics(path, wanted)
            return
    with reading(MATLAB.kind, path):
        yield from topics_of(arrays_of(path), path, wanted)


MATLAB = Format("MATLAB file", (".mat",), MATLAB_MAGIC, matlab_topics, has_stamps=False)
