"""A process that reads HDF5 and Parquet, because their libraries crash on some damaged files.

Run as a script, it imports nothing of this package. Its input is a line of JSON with format, path and limits, then
a line with the number of an array for each that is to be read. Its output is a line of JSON with what is in the
file, then for each request a line with type and shape, and the bytes; or a line with texts.
"""

from __future__ import annotations

import json
import math
import os
import sys
from collections.abc import Callable
from typing import Any

import numpy as np

NUMERIC = "biuf"  # NumPy's kinds
SENT = f"{NUMERIC}mM"  # as bytes; others as texts
OBJECT, SPARSE = "MATLAB_object_decode", "MATLAB_sparse"  # attributes
CLASS, EMPTY = "MATLAB_class", "MATLAB_empty"
REFERENCES = "#refs#"  # where MATLAB keeps what its cells and arrays of structures hold
MANY = {"{}": "a cell array", "()": "an array of structures"}
DEEPEST = 16  # groups within groups
MOST_OBJECTS = 20_000  # of a file
LONGEST = 400  # letters of a text: no number and no date is longer
SECONDS = 600  # of processor time
CHECKED = {"page_checksum_verification": True}  # where pages have check sums
TOLD = (  # attributes, in any case
    *("units", "unit", "scale_factor", "add_offset", "_fillvalue", "missing_value"),
    *("valid_min", "valid_max", "valid_range", "_unsigned"),
)


class Walk:
    """The datasets of a file by name.

    Attributes:
        datasets: a dataset with the field of it, None for all; or a text, why one is not read.
    """

    def __init__(self, file: Any, most_bytes: int):
        self.datasets: dict[str, tuple[Any, str | None] | str] = {}
        self._most, self._visited, self._count = most_bytes, {_address(file)}, 0
        self._file = file
        self._members(file, "", 0)

    def _members(self, group: Any, name: str, depth: int) -> None:
        import h5py

        for key in group:
            full_name = f"{name}.{key}" if name else key
            try:
                if not isinstance(group.get(key, getlink=True), h5py.HardLink):
                    self.datasets[full_name] = "a link"
                    continue
                member = group[key]
                number = _address(member)
                if key == REFERENCES:
                    continue
                if number in self._visited and isinstance(member, h5py.Group):  # of which there might be no end
                    self.datasets[full_name] = "a group that has another name, too"
                    continue
                self._visited.add(number)
                self._add(member, full_name, depth, _text(group.attrs.get(CLASS)) == "struct")
            except TooMany:
                raise
            except Exception as error:  # of this one alone
                self.datasets[full_name] = f"damaged: {_line(error)}"

    def _add(self, node: Any, name: str, depth: int, in_structure: bool = False) -> None:
        """Add an object, a group with what is in it."""
        import h5py

        self._count += 1
        if self._count > MOST_OBJECTS:
            raise TooMany(f"it has more than {MOST_OBJECTS} objects")
        if OBJECT in node.attrs or SPARSE in node.attrs:
            self.datasets[name] = "an object or a sparse matrix of MATLAB's"
        elif isinstance(node, h5py.Group):
            if depth < DEEPEST:
                self._members(node, name, depth + 1)
        elif isinstance(node, h5py.Dataset):
            self._dataset(node, name, depth, in_structure)

    def _dataset(self, dataset: Any, name: str, depth: int, in_structure: bool) -> None:
        import h5py

        kind = _text(dataset.attrs.get(CLASS))
        if dataset.is_virtual or dataset.external:
            self.datasets[name] = "kept in another file"
        elif dataset.chunks is not None and math.prod(dataset.chunks) * dataset.dtype.itemsize > self._most:
            self.datasets[name] = "packed in parts that are too large"
        elif dataset.size and not dataset.id.get_storage_size():
            self.datasets[name] = "never written"
        elif dataset.size and (why := _why_not_whole(dataset, self._most)):
            self.datasets[name] = why
        elif dataset.attrs.get(EMPTY, 0) or kind == "char" or dataset.shape is None:
            return
        elif h5py.check_ref_dtype(dataset.dtype) is h5py.Reference and (
            kind == "cell" or (in_structure and not kind)
        ):
            self._referred(dataset, name, depth, "{}" if kind == "cell" else "()")
        elif dataset.dtype.names is None:
            self.datasets[name] = (dataset, None)
        else:
            names = [field for field in dataset.dtype.names if dataset.dtype[field].kind in NUMERIC]
            self.datasets |= {f"{name}.{field}": (dataset, field) for field in names}

    def _referred(self, dataset: Any, name: str, depth: int, brackets: str) -> None:
        """Add the objects to which the entries of a cell array, or of a field of an array of structures, refer."""
        group, _, field = name.rpartition(".")
        self.datasets[name if brackets == "{}" else group] = MANY[brackets]
        if dataset.size > MOST_OBJECTS or depth >= DEEPEST:
            return
        for index, reference in enumerate(np.ravel(dataset[()]), 1):  # MATLAB counts along columns, from 1
            full_name = f"{name}{{{index}}}" if brackets == "{}" else f"{group}({index}).{field}"
            if reference:
                self._add(self._file[reference], full_name, depth + 1)


def _why_not_whole(dataset: Any, most_bytes: int) -> str:
    """Why a dataset does not hold as many numbers as it says; empty if it does, or may not be read for its size.

    The library gives the fill value for parts that are not there, as where their index is damaged.
    """
    stated, stored = dataset.size * dataset.dtype.itemsize, dataset.id.get_storage_size()
    if dataset.chunks is None:
        is_other = dataset.dtype.kind in NUMERIC and stored != stated
        return f"damaged: it says {stated} bytes, but has {stored}" if is_other else ""
    parts = math.prod(-(-side // chunk) for side, chunk in zip(dataset.shape, dataset.chunks, strict=True))
    count = dataset.id.get_num_chunks() if stated <= most_bytes else parts
    if count > parts:
        return f"damaged: it says that it has {parts} parts, but has {count}"
    is_missing = dataset.dtype.kind == "f" and np.isnan(dataset.fillvalue)
    return f"{parts - count} of its {parts} parts were never written, or are lost" * (
        count < parts and not is_missing
    )


def _address(node: Any) -> int:
    import h5py

    return h5py.h5o.get_info(node.id).addr


class TooMany(ValueError):
    """A file has more objects than are read."""


def _text(value: Any) -> str:
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value or "")


def _line(error: object) -> str:
    return " ".join(str(error).split())[:160] or type(error).__name__


def _described(dataset: Any, field: str | None) -> dict[str, Any]:
    """Shape, type and attributes of a dataset."""
    import h5py

    kind = dataset.dtype if field is None else dataset.dtype[field]
    attributes = dict(dataset.attrs) if field is None else {}
    attributes = {
        key: _plain(value)
        for key, value in attributes.items()
        if key.lower() in TOLD and not isinstance(value, h5py.Empty)
    }
    plain = kind.str if kind.kind in NUMERIC else str(kind)
    return {"shape": list(dataset.shape), "kind": kind.kind, "dtype": plain, "attributes": attributes}


def _plain(value: Any) -> Any:
    """An attribute as text, a number, or a list of these."""
    value = value.tolist() if isinstance(value, np.ndarray | np.generic) else value
    if isinstance(value, list):
        return [_plain(entry) for entry in value]
    return value if isinstance(value, int | float) else _text(value)


def _limit(memory: int) -> None:
    """Let this process take so much more memory, some processor time, and leave no image of it behind."""
    try:
        import resource

        with open("/proc/self/statm", encoding="ascii") as file:
            pages = int(file.read().split()[0])
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS))
        most = pages * resource.getpagesize() + memory
        resource.setrlimit(resource.RLIMIT_AS, (most, most))
    except (ImportError, OSError, ValueError):  # of other systems, or a limit that is lower already
        return


Reader = Callable[[int], np.ndarray]


def hdf5(request: dict) -> tuple[dict[str, Any], Reader]:
    """The datasets of an HDF5 file, and a function that reads one of them."""
    import h5py

    contents = Walk(h5py.File(request["path"], "r"), request["bytes"]).datasets
    names, descriptions = [*contents], dict[str, Any]()
    for name, entry in contents.items():
        try:
            descriptions[name] = entry if isinstance(entry, str) else _described(*entry)
        except Exception as error:
            descriptions[name] = f"damaged: {_line(error)}"

    def read(number: int) -> np.ndarray:
        entry = contents[names[number]]
        if isinstance(entry, str):
            raise ValueError(entry)
        dataset, field = entry
        return dataset[()] if field is None else dataset.fields(field)[()]

    return {"datasets": descriptions}, read


def parquet(request: dict) -> tuple[dict[str, Any], Reader]:
    """Names, rows and bytes of the columns of a Parquet file, or a folder of some, and what reads one of them."""
    import pyarrow.parquet

    numbers, size, tables = 0, 0, []
    for file in request["files"]:
        of_file = pyarrow.parquet.read_metadata(file)
        groups = [of_file.row_group(index) for index in range(of_file.num_row_groups)]
        parts = [group.column(index) for group in groups for index in range(group.num_columns)]
        numbers += of_file.num_rows * of_file.num_columns
        size += sum(part.total_uncompressed_size for part in parts)
    names = pyarrow.parquet.read_schema(request["files"][0]).names
    if request["files"] != [request["path"]] and max(8 * numbers, size) <= request["bytes"]:
        tables.append(pyarrow.parquet.read_table(request["path"], **CHECKED))
        names = tables[0].column_names  # those of its folders, too

    def read(number: int) -> np.ndarray:
        if not tables:
            tables.append(pyarrow.parquet.read_table(request["path"], **CHECKED))
        return tables[0].column(number).to_numpy(zero_copy_only=False)

    return {"names": names, "numbers": numbers, "bytes": size}, read


def main() -> None:
    """Answer requests until there are no more."""
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # so that nothing a library prints is taken for an answer
    request = json.loads(sys.stdin.readline())
    _limit(request["memory"])

    def answer(content: dict, data: bytes | memoryview = b"") -> None:
        out.write(json.dumps(content).encode() + b"\n")
        out.write(data)
        out.flush()

    try:
        description, read = {"hdf5": hdf5, "parquet": parquet}[request["format"]](request)
    except Exception as error:
        answer({"error": _line(error), "is_memory": isinstance(error, MemoryError)})
        return
    answer(description)
    for line in sys.stdin:
        try:
            values = np.ascontiguousarray(read(int(line)))
            if values.dtype.kind in SENT:
                description, data = {"dtype": values.dtype.str}, values.reshape(-1).view(np.uint8).data
            else:
                description, data = (
                    {"texts": [str(cell)[:LONGEST] for cell in values.reshape(-1)]},
                    memoryview(b""),
                )
        except Exception as error:
            answer({"error": _line(error), "is_memory": isinstance(error, MemoryError)})
        else:
            answer({**description, "shape": list(values.shape)}, data)


if __name__ == "__main__":
    main()
