"""PX4's ULog, by the package pyulog: topics with their own stamps, microseconds since the autopilot's start."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from thruster_env.plants.logs.recorders.topics import (
    MOST_FIELDS,
    Topic,
    Wanted,
    check_bytes,
    package,
    reading,
    silent,
    wants,
)

KIND = "ULog"
MAGIC = b"ULog\x01\x12\x35"
STAMP = "timestamp"
TICKS = 1e6  # a second


def topics(path: Path, wanted: Wanted = None) -> Iterator[Topic]:
    """The topics of a ULog: times are `timestamp`/10^6, [s] since the autopilot's start; a ULog has no units.

    Instance 1 of a topic is TOPIC#1. What a loss of power cut off in the middle of the data is read up to there.

    Args:
        path: of the file.
        wanted: columns whose topics are read; None for all.

    Raises:
        ValueError: if it is no ULog.

    Source: PX4, "ULog File Format".
    """
    check_bytes(path.stat().st_size, "a ULog", path)
    core = package("pyulog.core", KIND, path)
    names = None if wanted is None else sorted({one.partition(".")[0].partition("#")[0] for one in wanted})
    with reading(KIND, path), silent():
        with path.open("rb") as file:
            _check_formats(core.ULog(file, parse_header_only=True).message_formats)
        with path.open("rb") as file:
            found = core.ULog(file, names).data_list
        if not found and wanted is None:
            raise ValueError("it holds no data")
    while found:
        data = found.pop(0)
        name = f"{data.name}#{data.multi_id}" if data.multi_id else data.name
        if STAMP in data.data and wants(wanted, name):
            kinds = {one.field_name: one.type_str for one in data.field_data}
            yield Topic(name, data.data[STAMP] / TICKS, _numbers(data.data, kinds))


def _numbers(data: Mapping[str, np.ndarray], kinds: Mapping[str, str]) -> dict[str, np.ndarray]:
    """All fields but the stamp, text and padding."""
    some = [
        name for name in data if name != STAMP and kinds.get(name, "char") != "char" and "_padding" not in name
    ]
    return {name: data[name].astype(np.float64) for name in some}


def _check_formats(formats: Mapping) -> None:
    """Raise ValueError for formats that hold themselves, or others so often that they have too many fields."""
    sizes: dict[str, int] = {}

    def size(name: str, within: tuple[str, ...]) -> int:
        if name in within:
            raise ValueError(f"the format {name!r} holds itself")
        if name not in sizes:
            fields = formats[name].fields if name in formats else ()
            inner = (max(count, 1) * (size(kind, (*within, name)) or 1) for kind, count, _ in fields)
            sizes[name] = sum(inner)
        if sizes[name] > MOST_FIELDS:
            raise ValueError(f"the format {name!r} has {sizes[name]:.3g} fields")
        return sizes[name]

    for name in formats:
        size(name, ())
