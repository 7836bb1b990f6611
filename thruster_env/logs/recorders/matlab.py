"""Arrays of numbers in MATLAB files of version 5 to 7, read here: SciPy's reader crashes on damaged ones."""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from thruster_env.logs.recorders import hdf5
from thruster_env.logs.recorders.hdf5 import topics_of
from thruster_env.logs.recorders.topics import MOST_FIELDS, Topic, Wanted, check_bytes, reading

HEADER = 128  # bytes of a file
MATRIX, COMPRESSED = 14, 15  # types of elements
INT8, INT32, UINT32, UTF8 = 1, 5, 6, 16
NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}  # by type
TEXTS = (16, 17, 18)
CELL, STRUCTURE, NUMERIC, OPAQUE = 1, 2, range(6, 16), 17  # classes of arrays
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
KIND = "MATLAB file"
MAGIC = b"MATLAB "
HDF5 = b"MATLAB 7.3"


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
    elif of not in NUMERIC or flags & COMPLEX:
        arrays[name] = OTHERS.get(of, "of complex numbers" if of in NUMERIC else "an object of MATLAB's")
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


def topics(path: Path, wanted: Wanted = None) -> Iterator[Topic]:
    """The numeric arrays of one or two dimensions, by structure: STRUCT.FIELD; see `arrays.topics_of`.

    Objects, functions, cells and text are not read. A MATLAB file has no units.

    Args:
        path: of the file, version 5 or later.
        wanted: columns that are read; None for all.

    Raises:
        ValueError: if it is no MATLAB file, or its arrays are larger than may be read.

    Source: MathWorks, "MAT-File Format".
    """
    with path.open("rb") as file:
        if file.read(len(HDF5)) == HDF5:
            yield from hdf5.topics(path, wanted)
            return
    with reading(KIND, path):
        yield from topics_of(arrays_of(path), path, wanted)
