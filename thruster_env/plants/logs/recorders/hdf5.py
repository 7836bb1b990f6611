"""HDF5 and MATLAB's version 7.3, by the package h5py: arrays in groups, beside a vector of times."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from thruster_env.plants.logs.recorders.arrays import NUMERIC, topics_of
from thruster_env.plants.logs.recorders.topics import MOST_BYTES, Topic, Wanted, package, reading

KIND = "HDF5 file"
MAGIC = b"\x89HDF\r\n\x1a\n"
OBJECT, SPARSE = "MATLAB_object_decode", "MATLAB_sparse"  # attributes
REFERENCES = "#refs#"  # where MATLAB keeps what its cells and objects hold
DEEPEST = 16  # groups within groups
MOST_OBJECTS = 20_000  # of a file


def topics(path: Path, wanted: Wanted = None) -> Iterator[Topic]:
    """The numeric arrays of one or two dimensions, by group: GROUP.GROUP.DATASET; see `arrays.topics_of`.

    A unit is the attribute `units` or `unit` of a dataset. No link is followed, neither within the file nor to
    another one, and no object, reference or text is read; a dataset whose numbers lie in other files is none.

    Args:
        path: of the file.
        wanted: columns that are read, and times; None for all.

    Raises:
        ValueError: if it is no HDF5 file, or its arrays are larger than may be read.
    """
    h5py = package("h5py", KIND, path)
    with reading(KIND, path), h5py.File(path, "r") as file:
        found: dict[str, Any] = {}
        _walk(h5py, file, "", found, {h5py.h5o.get_info(file["/"].id).addr})
        yield from topics_of(found, path, wanted, _unit)


def _walk(h5py: Any, group: Any, name: str, found: dict[str, Any], seen: set[int]) -> None:
    """Collect the datasets of a group and of groups in it by name, each once; a text says why one is none."""
    for key in group:
        own = f"{name}.{key}" if name else key
        if not isinstance(group.get(key, getlink=True), h5py.HardLink):
            found[own] = "a link"
            continue
        one = group[key]
        number = h5py.h5o.get_info(one.id).addr
        if number in seen or key == REFERENCES:
            continue
        seen.add(number)
        if len(seen) > MOST_OBJECTS:
            raise ValueError(f"it has more than {MOST_OBJECTS} objects")
        if isinstance(one, h5py.Group):
            if OBJECT in one.attrs or SPARSE in one.attrs:
                found[own] = "an object or a sparse matrix of MATLAB's"
            elif own.count(".") < DEEPEST:
                _walk(h5py, one, own, found, seen)
        elif isinstance(one, h5py.Dataset):
            found.update(_datasets(own, one))


def _datasets(name: str, one: Any) -> dict[str, Any]:
    """A dataset by name, or its columns where it is a table."""
    if OBJECT in one.attrs:
        return {name: "an object of MATLAB's"}
    if one.is_virtual or one.external:
        return {name: "kept in another file"}
    if one.chunks is not None and math.prod(one.chunks) * one.dtype.itemsize > MOST_BYTES:
        return {name: "packed in parts that are too large"}
    if one.attrs.get("MATLAB_empty", 0) or one.attrs.get("MATLAB_class") == b"char" or one.shape is None:
        return {}
    if one.dtype.names is None:
        return {name: one}
    return {f"{name}.{field}": Member(one, field) for field in one.dtype.names if one.dtype[field].kind in NUMERIC}


class Member:
    """A column of numbers of a dataset that is a table."""

    def __init__(self, table: Any, field: str):
        """Keep both; nothing is read."""
        self.table, self.field = table, field
        self.shape, self.dtype = table.shape, table.dtype[field]
        self.attrs: dict[str, str] = {}

    def __getitem__(self, key: tuple) -> np.ndarray:
        """Read the column."""
        return self.table.fields(self.field)[key]


def _unit(one: Any) -> str:
    """The unit that a dataset says it has; of "seconds since 2026-05-01", as of CF conventions, "seconds"."""
    for name in ("units", "unit"):
        text = one.attrs.get(name)
        text = text.decode("utf-8", "replace") if isinstance(text, bytes) else text
        if isinstance(text, str):
            return text.partition(" since ")[0].strip()
    return ""
