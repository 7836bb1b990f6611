"""PX4's ULog, by the package pyulog: topics with their own stamps, microseconds since the autopilot's start."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from thruster_env.logs.recorders.topics import (
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
START, HEADER = 16, 3  # bytes before the first message, and before the body of each
LONGEST = 10_000  # bytes of a message of a kind that is not known
SEVERAL = 4  # messages that follow one another: none begin by chance
APPENDED = struct.pack("<HB", 40, ord("B")) + bytes(8) + b"\1"  # flags of a log to which data were appended
FORMAT, SUBSCRIPTION = b"FA"
KINDS = b"ABCDFILMOPQRS"  # of messages
TEXTS, LEVELS = b"LC", (*(bytes([level]) for level in b"01234567"),)  # messages of text, and what they begin with


def topics(path: Path, wanted: Wanted = None) -> Iterator[Topic]:
    """The topics of a ULog: times are `timestamp`/10^6, [s] since the autopilot's start.

    A ULog has no units: they are in the names of fields, or those of PX4's messages. Instance 1 of a topic is
    TOPIC#1. What a loss of power cut off is read up to there, and what is damaged around that.

    Args:
        path: of the file.
        wanted: columns whose topics are read; None for all.

    Raises:
        ValueError: if it is no ULog.

    Sources: PX4, "ULog File Format"; PX4, "uORB Message Reference" (units).
    """
    check_bytes(path.stat().st_size, "a ULog", path)
    core = package("pyulog.core", KIND, path)
    names = None if wanted is None else sorted({column.partition(".")[0].partition("#")[0] for column in wanted})
    with reading(KIND, path), silent():
        content = path.read_bytes()
        parts = _whole_parts(content)
        strays = _checked_definitions(content, parts, path)
        size = len(content)
        lost = size - START - sum(end - begin for begin, end in parts)
        if lost:  # where bytes are left out, the places of what was appended are no longer right
            content = b"".join([content[:START], *(content[begin:end] for begin, end in parts)])
            content = content.replace(APPENDED, APPENDED[:-1] + b"\0", 1)
        _check_formats(core.ULog(BytesIO(content), parse_header_only=True).message_formats)
        log = core.ULog(BytesIO(content), names)
        data_list = log.data_list
        if not data_list and wanted is None:
            raise ValueError("it holds no data")
    hole_count = 1 + len(parts) - (not parts or parts[0][0] == START) - (not parts or parts[-1][1] == size)
    damage = f"{lost} bytes in {hole_count} place{'s' * (hole_count != 1)} of the log belong to no message"
    if strays:
        are = "message is" if strays == 1 else "messages are"
        damage = f"{damage}, and " * bool(lost) + f"{strays} {are} damaged, or of a kind that is not known"
    elif not lost:
        damage = "some messages of the log are not as long as their formats say" if log.file_corruption else ""
    while data_list:  # what is read already need not stay in memory
        same_topic = [data_list.pop(0)]
        topic, instance = same_topic[0].name, same_topic[0].multi_id
        while data_list and (data_list[0].name, data_list[0].multi_id) == (topic, instance):
            same_topic.append(data_list.pop(0))
        name = f"{topic}#{instance}" if instance else topic
        if wants(wanted, name):
            yield joined([_topic(name, data, damage) for data in same_topic])


def _topic(name: str, data: Any, damage: str) -> Topic:
    if STAMP not in data.data:
        return Topic(name, None, {}, unread={"": "messages without times"})
    kinds = {field.field_name: field.type_str for field in data.field_data}
    numbers = _numbers(data.data, kinds)
    known = {field: UNITS.get(field.rpartition(".")[2].partition("[")[0], "") for field in numbers}
    units = {field: unit for field, unit in known.items() if unit}
    return Topic(name, data.data[STAMP] / TICKS, numbers, units, damage=damage)


def _whole_parts(content: bytes) -> list[tuple[int, int]]:
    """Begin and end of the parts of a ULog in which messages follow one another; damage and a cut lie between.

    The package goes through damaged parts byte by byte, and reads what the next bytes say each time.
    """
    parts, offset = [], START
    while offset < len(content):
        begin = offset
        while (after := _after(content, offset)) is not None:
            offset = after
        if offset > begin:
            parts.append((begin, offset))
        offset = next(
            (candidate for candidate in range(offset + 1, len(content)) if _begins(content, candidate)),
            len(content),
        )
    return parts


def _after(content: bytes, offset: int) -> int | None:
    """The end of the message that begins at an offset, None if none does."""
    if offset + HEADER > len(content):
        return None
    count, kind = struct.unpack_from("<HB", content, offset)
    end = offset + HEADER + count
    if kind not in KINDS:  # one that is newer than these
        follows = end + HEADER <= len(content) and content[end + 2] in KINDS
        return end if kind and 0 < count <= LONGEST and follows else None
    return end if end <= len(content) else None


def _begins(content: bytes, offset: int) -> bool:
    """Whether several messages follow one another from an offset on."""
    if offset + HEADER > len(content) or content[offset + 2] not in KINDS:
        return False
    for _ in range(SEVERAL):
        after = _after(content, offset)
        if after is None:
            return False
        if after == len(content):
            return True
        offset = after
    return True


def _checked_definitions(content: bytes, parts: Sequence[tuple[int, int]], path: Path) -> int:
    """The number of messages that contradict their kind, for instance after damage; the package skips them.

    Raises Refused for a format that is defined twice, or a number that stands for two topics: the package keeps
    the last one, and drops what belongs to the first.
    """
    formats, subscribed, strays = dict[bytes, bytes](), set[int](), 0
    for offset, last in parts:
        while offset < last:
            count, kind = struct.unpack_from("<HB", content, offset)
            begin, end = offset + HEADER, offset + HEADER + count
            is_text = kind not in TEXTS or content[begin : begin + 1] in LEVELS
            if kind not in KINDS or not is_text or (kind == FORMAT and subscribed):  # formats come first
                strays += 1
            elif kind == FORMAT:
                name, _, text = content[begin:end].partition(b":")
                if formats.setdefault(name, text) != text:
                    what = name[:80].decode("ascii", "replace")
                    raise Refused(f"a ULog must define a format once, but {path} defines {what!r} twice")
            elif kind == SUBSCRIPTION and count > 3:
                number = int.from_bytes(content[begin + 1 : begin + 3], "little")
                if number in subscribed:
                    what = content[begin + 3 : end][:80].decode("ascii", "replace")
                    rule = "a ULog must give each subscription its own number"
                    raise Refused(f"{rule}, but {path} gives {number} again, to {what!r}")
                subscribed.add(number)
            offset = end
    return strays


def _numbers(data: Mapping[str, np.ndarray], kinds: Mapping[str, str]) -> dict[str, np.ndarray]:
    """All fields but the stamp, text and padding."""
    names = [name for name in data if name != STAMP and "_padding" not in name]
    return {name: data[name].astype(np.float64) for name in names if kinds.get(name, "char") != "char"}


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
