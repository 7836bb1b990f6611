"""PX4's ULog, by the package pyulog: topics with their own stamps, microseconds since the autopilot's start."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from thruster_env.plants.logs.recorders.topics import (
    MOST_FIELDS,
    Refused,
    Topic,
    Wanted,
    check_bytes,
    joined,
    package,
    reading,
    silent,
    wants,
)

KIND = "ULog"
MAGIC = b"ULog\x01\x12\x35"
STAMP = "timestamp"
TICKS = 1e6  # a second
UNITS = {  # of fields of PX4's messages whose names have none that headers have, or another one
    **{"gyro_rad": "rad/s", "discharged_mah": "mA*h", "magnetometer_ga": "gauss"},
    **dict.fromkeys(("voltage_v", "voltage_filtered_v", "voltage5v_v", "esc_voltage"), "V"),
    **dict.fromkeys(("current_a", "current_filtered_a", "current_average_a", "esc_current"), "A"),
    **dict.fromkeys(("baro_pressure_pa", "differential_pressure_pa", "differential_pressure_filtered_pa"), "Pa"),
    **dict.fromkeys(("baro_temp_celcius", "air_temperature_celsius", "esc_temperature"), "degC"),
}
START = 16  # bytes before the first message
FORMAT, SUBSCRIPTION = b"FA"
KINDS = b"ABCDFILMOPQRS"  # of messages


def topics(path: Path, wanted: Wanted = None) -> Iterator[Topic]:
    """The topics of a ULog: times are `timestamp`/10^6, [s] since the autopilot's start.

    A ULog has no units: they are in the names of fields, or those of PX4's messages. Instance 1 of a topic is
    TOPIC#1. What a loss of power cut off in the middle of the data is read up to there.

    Args:
        path: of the file.
        wanted: columns whose topics are read; None for all.

    Raises:
        ValueError: if it is no ULog.

    Sources: PX4, "ULog File Format"; PX4, "uORB Message Reference" (units).
    """
    check_bytes(path.stat().st_size, "a ULog", path)
    core = package("pyulog.core", KIND, path)
    names = None if wanted is None else sorted({one.partition(".")[0].partition("#")[0] for one in wanted})
    with reading(KIND, path), silent():
        with path.open("rb") as file:
            _check_formats(core.ULog(file, parse_header_only=True).message_formats)
        end = _check_definitions(path.read_bytes(), path)
        with path.open("rb") as file:
            log = core.ULog(file, names)
            found = log.data_list
        if not found and wanted is None:
            raise ValueError("it holds no data")
    damage = _damage(end, path.stat().st_size, log.file_corruption)
    while found:
        parts = [found.pop(0)]
        while found and (found[0].name, found[0].multi_id) == (parts[0].name, parts[0].multi_id):
            parts.append(found.pop(0))
        name = f"{parts[0].name}#{parts[0].multi_id}" if parts[0].multi_id else parts[0].name
        if wants(wanted, name):
            yield joined([_topic(name, data, damage) for data in parts])


def _topic(name: str, data: Any, damage: str) -> Topic:
    if STAMP not in data.data:
        return Topic(name, None, {}, unread={"": "messages without times"})
    kinds = {one.field_name: one.type_str for one in data.field_data}
    numbers = _numbers(data.data, kinds)
    known = {field: UNITS.get(field.rpartition(".")[2].partition("[")[0], "") for field in numbers}
    units = {field: unit for field, unit in known.items() if unit}
    return Topic(name, data.data[STAMP] / TICKS, numbers, units, damage=damage)


def _check_definitions(content: bytes, path: Path) -> int:
    """Where the messages of a ULog end that follow one another without damage [bytes].

    Raises:
        Refused: for a format that is defined twice, or a number that stands for two topics: the package keeps the
            last one, and drops what belongs to the first.
    """
    place, formats, subscribed = START, dict[bytes, bytes](), set[int]()
    while place + 3 <= len(content):
        count, kind = struct.unpack_from("<HB", content, place)
        if place + 3 + count > len(content) or kind not in KINDS:
            break
        if kind == FORMAT:
            name, _, text = content[place + 3 : place + 3 + count].partition(b":")
            if formats.setdefault(name, text) != text:
                what = name[:80].decode("ascii", "replace")
                raise Refused(f"a ULog must define a format once, but {path} defines {what!r} twice")
        elif kind == SUBSCRIPTION and count > 3:
            number = int.from_bytes(content[place + 4 : place + 6], "little")
            if number in subscribed:
                what = content[place + 6 : place + 3 + count][:80].decode("ascii", "replace")
                rule = "a ULog must give each subscription its own number"
                raise Refused(f"{rule}, but {path} gives {number} again, to {what!r}")
            subscribed.add(number)
        place += 3 + count
    return place


def _damage(end: int, size: int, is_corrupt: bool) -> str:
    """What of a file is damaged, in words."""
    if is_corrupt:
        return f"the log is damaged from byte {end} on, and some messages there are not read"
    return f"the log is cut off: its last {size - end} bytes are no whole message" if end < size else ""


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
