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
from thruster_env.logs.recorders.process import Opened, opened
from thruster_env.logs.recorders.topics import (
    MOST_COLUMNS,
    Refused,
    Topic,
    Wanted,
    check_bytes,
    columns_of,
    package,
    reading,
)

# Arrays by name, as MATLAB and HDF5 keep them: which are channels, and which vector has their times.


NUMERIC = "biuf"  # NumPy's kinds
FEWEST = 2  # samples; what has fewer is a constant


def topics_of(
    found: Mapping[str, Any],
    path: Path,
    wanted: Wanted = None,
    unit: Callable[[Any], Sequence[str]] = lambda one: (),
) -> Iterator[Topic]:
    """The channels among arrays: a vector, or a matrix whose columns are channels NAME[0], NAME[1] and so on.

    Times are the vector `time` (or t, time_ms and the like) beside an array, or else in a group around it, if it
    is as long as the array; of a matrix, times may run along either side.

    Args:
        found: arrays by "GROUP.NAME", with shape, dtype and what `[...]` reads; or a text, why one is refused.
        path: of the file, for messages.
        wanted: columns that are read; None for all.
        unit: of an array, or one for each of its columns; empty where it has none.

    Raises:
        ValueError: if an array is wanted that is refused, or too large.
    """
    sizes = {name: _size(one) for name, one in found.items()}
    vectors: dict[str, dict[str, int]] = {}  # of times, their lengths by group and name
    for name, size in sizes.items():
        if size is not None and size[1] == 1 and _is_time(name):
            vectors.setdefault(name.rpartition(".")[0], {})[name] = size[0]
    known: dict[str, tuple[np.ndarray | None, str]] = {}
    if wanted is None:
        within = {name[:place] for name in found for place, letter in enumerate(name) if letter in "({"}
        refused = {name: why for name, one in found.items() if (why := _why_not(one)) and name not in within}
        yield from [Topic("", None, {}, unread=refused)] if refused else []
    for name, one in found.items():
        if wanted is not None and not any(each == name or each.startswith(f"{name}[") for each in wanted):
            continue
        if why := _why_not(one):
            if wanted is not None:
                raise Refused(f"a field must be an array of numbers, but {name!r} is {why} ({path})")
            continue
        if sizes[name] is None:
            continue
        clock, along = next(
            (each for each in _clocks(name, vectors) if each[1] in one.shape), (None, max(one.shape))
        )
        if math.prod(one.shape) > MOST_COLUMNS * along:
            continue
        group, _, field = name.rpartition(".")
        try:
            values = _read(name, one, path)
            if clock is not None and clock not in known:
                known = {clock: _times(clock, found[clock], path, unit)}
        except Refused:
            raise
        except Exception as error:  # of this one alone
            why = " ".join(str(error).split())[:160] or type(error).__name__
            if wanted is not None:
                raise Refused(
                    f"a field must be one that can be read, but {name!r} is not: {why} ({path})"
                ) from None
            yield Topic("", None, {}, unread={name: f"damaged: {why}"})
            continue
        values = values if values.shape[0] == along else values.T
        fields = columns_of(field, values)
        own, taken = known[clock] if clock is not None else (None, "")
        yield Topic(group, own, fields, _units(unit(one), [*fields]), taken=taken)


def _units(texts: Sequence[str], fields: Sequence[str]) -> dict[str, str]:
    """The units of fields: one for all or one for each; of any other number all texts, which are no unit."""
    each = texts if len(texts) == len(fields) else [", ".join(texts)] * len(fields)
    return {field: text for field, text in zip(fields, each, strict=True) if text}


def _times(
    clock: str, one: Any, path: Path, unit: Callable[[Any], Sequence[str]]
) -> tuple[np.ndarray | None, str]:
    """The times in a vector [s], None for those of an unknown unit; and how they were read, in words."""
    try:
        times = _read(clock, one, path).astype(np.float64)
        return in_seconds(times, ", ".join(unit(one)) or parted(clock)[1], clock, f"{clock!r} of {path}")
    except Refused:
        raise
    except ValueError:
        return None, ""


def _why_not(one: Any) -> str:
    """Why an array is not read, empty if it may be."""
    if isinstance(one, str):
        return one
    if one.dtype.kind not in NUMERIC:
        return getattr(one, "what", f"of {one.dtype}")
    sides = _sides(one)
    if len(sides) > 2:
        return f"of {len(sides)} dimensions"
    return (
        f"a matrix of {sides[0]} times {sides[1]}" if min(sides[1:], default=0) > MOST_COLUMNS < sides[0] else ""
    )


def _sides(one: Any) -> list[int]:
    """The sides of an array of more than one entry; Simulink writes signals as 1 x 1 x samples."""
    return [side for side in one.shape if side != 1]


def _size(one: Any) -> tuple[int, int] | None:
    """The longer and the shorter side of a vector or matrix of numbers, None for anything else."""
    if _why_not(one) or 0 in one.shape or not (sides := _sides(one)):
        return None
    return max(sides), min(sides) if len(sides) == 2 else 1


def _is_time(name: str) -> bool:
    return parted(name.rpartition(".")[2])[0] in TIME_NAMES


def _clocks(name: str, vectors: Mapping[str, Mapping[str, int]]) -> Iterator[tuple[str, int]]:
    """Vectors of times that may be those of an array, and their lengths: beside it, then in groups around it."""
    group = name
    while group:
        group = group.rpartition(".")[0]
        yield from vectors.get(group, {}).items()


def _read(name: str, one: Any, path: Path) -> np.ndarray:
    """An array, of which sides of one entry are left out."""
    check_bytes(math.prod(one.shape) * max(one.dtype.itemsize, 8), f"the array {name!r}", path)
    return np.squeeze(np.asarray(one[...]))


KIND = "HDF5 file"
MAGIC = b"\x89HDF\r\n\x1a\n"
UNITS, SCALE, OFFSET = ("units", "unit"), "scale_factor", "add_offset"  # attributes
MISSING = ("_fillvalue", "missing_value")
LEAST, GREATEST, RANGE = "valid_min", "valid_max", "valid_range"
UNSIGNED = "_unsigned"


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
        found = {
            name: one if isinstance(one, str) else Dataset(file, number, one)
            for number, (name, one) in enumerate(file.told["datasets"].items())
        }
        yield from topics_of(found, path, wanted, _unit)


class Dataset:
    """A dataset in a file that another process reads."""

    def __init__(self, file: Opened, number: int, told: Mapping[str, Any]):
        """Keep what is known of it; nothing is read."""
        self._file, self._number = file, number
        self.shape = tuple(int(one) for one in told["shape"])
        self.dtype = np.dtype(told["dtype"] if told["kind"] in NUMERIC else object)
        self.what = f"of {told['dtype']}"
        self.attributes = {key.lower(): value for key, value in told["attributes"].items()}

    def __getitem__(self, key: Any) -> np.ndarray:
        """Read all of it, in its unit."""
        stored = self._file.read(self._number)
        is_unsigned = stored.dtype.kind == "i" and str(self.attributes.get(UNSIGNED)).lower() == "true"
        stored = stored.view(stored.dtype.str.replace("i", "u")) if is_unsigned else stored
        scale, offset, least, greatest = (self._number_of(name) for name in (SCALE, OFFSET, LEAST, GREATEST))
        absent = [one for name in MISSING for one in self._numbers_of(name)]
        if RANGE in self.attributes:
            least, greatest = self._numbers_of(RANGE)
        if is_unsigned:  # the numbers of attributes have the type of what is stored
            absent = [one % 256**stored.itemsize for one in absent]
        if all(one is None for one in (scale, offset, least, greatest)) and not absent:
            return stored
        values = stored.astype(np.float64) * (1.0 if scale is None else scale) + (offset or 0.0)
        for one in absent:
            values[stored == one] = np.nan
        values[stored < (-np.inf if least is None else least)] = np.nan
        values[stored > (np.inf if greatest is None else greatest)] = np.nan
        return values

    def _number_of(self, name: str) -> float | int | None:
        """An attribute that is a number, or an array of one; None for none."""
        some = self._numbers_of(name)
        if len(some) > 1:
            raise ValueError(f"the attribute {name}={some} is no number")
        return some[0] if some else None

    def _numbers_of(self, name: str) -> list[float | int]:
        """The numbers of an attribute, empty for none."""
        value = self.attributes.get(name, [])
        some = value if isinstance(value, list) else [value]
        if not all(isinstance(one, int | float) for one in some):
            raise ValueError(f"the attribute {name}={value!r} is no number")
        return some


def _unit(one: Dataset) -> list[str]:
    """The units that a dataset says it has; of "seconds since 2026-05-01", as of CF conventions, "seconds"."""
    for name in UNITS:
        value = one.attributes.get(name)
        some = np.ravel(np.array(value, object)).tolist()
        if value is not None and all(isinstance(text, str) for text in some):
            return [text.partition(" since ")[0].strip() for text in some]
    return []
