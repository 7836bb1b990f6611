"""HDF5 and MATLAB's version 7.3, by the package h5py in a process of its own: arrays beside a vector of times."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from thruster_env.logs.recorders.arrays import NUMERIC, topics_of
from thruster_env.logs.recorders.process import Opened, opened
from thruster_env.logs.recorders.topics import Topic, Wanted, package, reading

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
