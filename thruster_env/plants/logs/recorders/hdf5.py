"""HDF5 and MATLAB's version 7.3, by the package h5py in a process of its own: arrays beside a vector of times."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from thruster_env.plants.logs.recorders.arrays import NUMERIC, topics_of
from thruster_env.plants.logs.recorders.process import Opened, opened
from thruster_env.plants.logs.recorders.topics import Topic, Wanted, package, reading

KIND = "HDF5 file"
MAGIC = b"\x89HDF\r\n\x1a\n"
UNITS, SCALE, OFFSET = ("units", "unit"), "scale_factor", "add_offset"  # attributes
MISSING = ("_fillvalue", "missing_value")


def topics(path: Path, wanted: Wanted = None) -> Iterator[Topic]:
    """The numeric arrays of one or two dimensions, by group: GROUP.GROUP.DATASET; see `arrays.topics_of`.

    A unit is the attribute `units` or `unit` of a dataset, in any case, a text or an array of one. Numbers are
    `scale_factor` times what is stored plus `add_offset`, NaN where that is `_FillValue` or `missing_value`. Of
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
        absent = [_number(self.attributes[name]) for name in MISSING if name in self.attributes]
        scale, offset = (_number(self.attributes.get(name)) for name in (SCALE, OFFSET))
        if scale is None and offset is None and not absent:
            return stored
        values = stored * (1.0 if scale is None else scale) + (0.0 if offset is None else offset)
        for one in absent:
            values = np.where(stored == one, np.nan, values)
        return values


def _number(value: Any) -> float | int | None:
    """An attribute that is a number, or an array of one; None for none."""
    value = value[0] if isinstance(value, list) and len(value) == 1 else value
    if value is None or isinstance(value, int | float):
        return value
    raise ValueError(f"the attribute {value!r} is no number")


def _unit(one: Dataset) -> str:
    """The unit that a dataset says it has; of "seconds since 2026-05-01", as of CF conventions, "seconds"."""
    for name in UNITS:
        value = one.attributes.get(name)
        while isinstance(value, list) and len(value) == 1:
            value = value[0]
        if isinstance(value, str):
            return value.partition(" since ")[0].strip()
    return ""
