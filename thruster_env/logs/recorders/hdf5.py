"""HDF5 and MATLAB's version 7.3, by the package h5py in a process of its own: arrays beside a vector of times."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from thruster_env.logs.columns import TIME_NAMES, parted
from thruster_env.logs.grid import in_seconds
from thruster_env.logs.recorders.topics import (
    MOST_COLUMNS,
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

NUMERIC = "biuf"  # NumPy's kinds
FEWEST = 2  # samples; what has fewer is a constant

# Of files.
KIND = "HDF5 file"
MAGIC = b"\x89HDF\r\n\x1a\n"
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


def topics(path: Path, wanted: Wanted = None) -> Iterator[Topic]:
    """The numeric arrays of one or two dimensions, by group: GROUP.GROUP.DATASET; see `arrays.topics_of`.

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
        package("h5py", KIND, path)  # which says how to install it
    with reading(KIND, path), opened("hdf5", path) as file:
        datasets = {
            name: description if isinstance(description, str) else Dataset(file, number, description)
            for number, (name, description) in enumerate(file.contents["datasets"].items())
        }
        yield from topics_of(datasets, path, wanted, _unit)


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
