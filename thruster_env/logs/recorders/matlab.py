"""MATLAB's .mat files: version 5 to 7 by ourselves, version 7.3 by h5py."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from thruster_env.logs.recorders import hdf5
from thruster_env.logs.recorders.arrays import topics_of
from thruster_env.logs.recorders.mat_elements import arrays_of
from thruster_env.logs.recorders.topics import Topic, Wanted, reading

KIND = "MATLAB file"
MAGIC = b"MATLAB "
HDF5 = b"MATLAB 7.3"


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
