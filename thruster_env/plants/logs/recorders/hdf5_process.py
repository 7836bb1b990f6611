"""A process of its own that reads HDF5 files, for the library in C breaks off at some that are damaged.

Run as a script, it imports nothing of this package. Its input is a line of JSON with the path and limits, then a
line with the number of a dataset for each that is to be read. Its output is a line of JSON with all datasets, then
for each request a line with type, shape and size, and the bytes.
"""

from __future__ import annotations

import json
import math
import os
import sys
from typing import Any

import h5py
import numpy as np

NUMERIC = "biuf"  # NumPy's kinds
OBJECT, SPARSE = "MATLAB_object_decode", "MATLAB_sparse"  # attributes
CLASS, EMPTY = "MATLAB_class", "MATLAB_empty"
REFERENCES = "#refs#"  # where MATLAB keeps what its cells and arrays of structures hold
MANY = {"{}": "a cell array", "()": "an array of structures"}
DEEPEST = 16  # groups within groups
MOST_OBJECTS = 20_000  # of a file
SECONDS = 600  # of processor time
TOLD = ("units", "unit", "scale_factor", "add_offset", "_fillvalue", "missing_value")  # attributes, in any case


class Walk:
    """The datasets of a file by name.

    Attributes:
        found: a dataset with the field of it, None for all; or a text, why one is not read.
    """

    def __init__(self, file: Any, most_bytes: int):
        """Collect all that the file has."""
        self.found: dict[str, tuple[Any, str | None] | str] = {}
        self._most, self._seen, self._count = most_bytes, {h5py.h5o.get_info(file.id).addr}, 0
        self._file = file
        self._members(file, "", 0)

    def _members(self, group: Any, name: str, depth: int) -> None:
        for key in group:
            own = f"{name}.{key}" if name else key
            try:
                if not isinstance(group.get(key, getlink=True), h5py.HardLink):
                    self.found[own] = "a link"
                    continue
                one = group[key]
                number = h5py.h5o.get_info(one.id).addr
                if number in self._seen or key == REFERENCES:
                    continue
                self._seen.add(number)
                self._add(one, own, depth, _text(group.attrs.get(CLASS)) == "struct")
            except TooMany:
                raise
            except Exception as error:  # of this one alone
                self.found[own] = f"damaged: {_line(error)}"

    def _add(self, one: Any, name: str, depth: int, in_structure: bool = False) -> None:
        """Add an object, a group with what is in it."""
        self._count += 1
        if self._count > MOST_OBJECTS:
            raise TooMany(f"it has more than {MOST_OBJECTS} objects")
        if OBJECT in one.attrs or SPARSE in one.attrs:
            self.found[name] = "an object or a sparse matrix of MATLAB's"
        elif isinstance(one, h5py.Group):
            if depth < DEEPEST:
                self._members(one, name, depth + 1)
        elif isinstance(one, h5py.Dataset):
            self._dataset(one, name, depth, in_structure)

    def _dataset(self, one: Any, name: str, depth: int, in_structure: bool) -> None:
        kind = _text(one.attrs.get(CLASS))
        if one.is_virtual or one.external:
            self.found[name] = "kept in another file"
        elif one.chunks is not None and math.prod(one.chunks) * one.dtype.itemsize > self._most:
            self.found[name] = "packed in parts that are too large"
        elif one.attrs.get(EMPTY, 0) or kind == "char" or one.shape is None:
            return
        elif h5py.check_ref_dtype(one.dtype) is h5py.Reference and (kind == "cell" or (in_structure and not kind)):
            self._referred(one, name, depth, "{}" if kind == "cell" else "()")
        elif one.dtype.names is None:
            self.found[name] = (one, None)
        else:
            names = [field for field in one.dtype.names if one.dtype[field].kind in NUMERIC]
            self.found |= {f"{name}.{field}": (one, field) for field in names}

    def _referred(self, one: Any, name: str, depth: int, brackets: str) -> None:
        """Add what the entries of a cell array, or those of a field of an array of structures, refer to."""
        group, _, field = name.rpartition(".")
        self.found[name if brackets == "{}" else group] = MANY[brackets]
        if one.size > MOST_OBJECTS or depth >= DEEPEST:
            return
        for place, reference in enumerate(
            np.asarray(one[()]).reshape(-1), 1
        ):  # MATLAB counts along columns, from 1
            own = f"{name}{{{place}}}" if brackets == "{}" else f"{group}({place}).{field}"
            if reference:
                self._add(self._file[reference], own, depth + 1)


class TooMany(ValueError):
    """A file has more objects than are read."""


def _text(value: Any) -> str:
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value or "")


def _line(error: object) -> str:
    return " ".join(str(error).split())[:160] or type(error).__name__


def _described(one: Any, field: str | None) -> dict[str, Any]:
    """Shape, type and attributes of a dataset."""
    kind = one.dtype if field is None else one.dtype[field]
    told = (
        {}
        if field is not None
        else {key: _plain(value) for key, value in one.attrs.items() if key.lower() in TOLD}
    )
    plain = kind.str if kind.kind in NUMERIC else str(kind)
    return {"shape": list(one.shape), "kind": kind.kind, "dtype": plain, "attributes": told}


def _plain(value: Any) -> Any:
    """An attribute as text, a number, or a list of these."""
    value = value.tolist() if isinstance(value, np.ndarray | np.generic) else value
    if isinstance(value, list):
        return [_plain(one) for one in value]
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


def main() -> None:
    """Answer requests until there are no more."""
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # so that nothing the library prints is taken for an answer
    request = json.loads(sys.stdin.readline())
    _limit(request["memory"])

    def answer(content: dict, data: bytes | memoryview = b"") -> None:
        out.write(json.dumps(content).encode() + b"\n")
        out.write(data)
        out.flush()

    try:
        with h5py.File(request["path"], "r") as file:
            found = Walk(file, request["bytes"]).found
            names, told = [*found], {}
            for name, one in found.items():
                try:
                    told[name] = one if isinstance(one, str) else _described(*one)
                except Exception as error:
                    told[name] = f"damaged: {_line(error)}"
            answer({"datasets": told})
            for line in sys.stdin:
                dataset, field = found[names[int(line)]]
                try:
                    values = dataset[()] if field is None else dataset.fields(field)[()]
                except Exception as error:
                    answer({"error": _line(error)})
                    continue
                values = np.ascontiguousarray(values)
                answer(
                    {"dtype": values.dtype.str, "shape": list(values.shape)},
                    memoryview(values.reshape(-1)).cast("B"),
                )
    except Exception as error:
        answer({"error": _line(error)})


if __name__ == "__main__":
    main()
