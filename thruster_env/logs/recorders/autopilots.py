"""Logs of autopilots: ArduPilot's DataFlash (.bin) by the package pymavlink, PX4's ULog by the package pyulog."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from io import BytesIO
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from thruster_env.logs.recorders.topics import (
    MOST_FIELDS,
    Format,
    Refused,
    Topic,
    Wanted,
    check_bytes,
    columns_of,
    joined,
    package,
    reading,
    silent,
    wants,
)

DATAFLASH_MAGIC = b"\xa3\x95"
STAMPS = {"TimeUS": 1e6, "TimeMS": 1e3}  # ticks a second
OF_WEEK = {"T": 1e3}  # of old messages GPS, whose TimeMS counts from the beginning of the week
HEADER = 3  # bytes before the body of a message
FMT, DESCRIPTION = 0x80, 89  # the message that describes others, and its bytes
LONGEST = 528  # bytes at the end that may be no message, the rest of a page
NUMBERS = {  # NumPy's kind of each of ArduPilot's, and by what a message's number is divided
    **{"b": ("i1", 1.0), "B": ("u1", 1.0), "M": ("u1", 1.0), "h": ("<i2", 1.0), "H": ("<u2", 1.0)},
    **{"i": ("<i4", 1.0), "I": ("<u4", 1.0), "q": ("<i8", 1.0), "Q": ("<u8", 1.0)},
    **{"g": ("<f2", 1.0), "f": ("<f4", 1.0), "d": ("<f8", 1.0), "a": ("V64", 1.0)},  # a: 32 of int16
    **{"c": ("<i2", 1e2), "C": ("<u2", 1e2), "e": ("<i4", 1e2), "E": ("<u4", 1e2), "L": ("<i4", 1e7)},
}
FORMATS = ("FMT", "FMTU", "UNIT", "MULT")  # messages that describe others
TEXTS = {"n": 4, "N": 16, "Z": 64}  # bytes
UNITS_OF_ARDUPILOT = {
    **dict.fromkeys(("degheading", "deglatitude", "deglongitude"), "deg"),
    "instance": "",
}  # ArduPilot's own


def dataflash_topics(path: Path, wanted: Wanted = None) -> Iterator[Topic]:
    """The messages of a DataFlash log: times are TimeUS/10^6 (in old logs TimeMS/10^3), [s] since start.

    Units are those of the messages UNIT, MULT and FMTU, where the log has them. Instance 1 of a message, by the
    field that FMTU marks, is NAME#1. What a loss of power cut off is read up to there. Messages of a name with
    several formats, as of logs that were put together, are matched by the names of fields, in the file's order.

    Args:
        path: of the file.
        wanted: columns whose messages are read; None for all.

    Raises:
        ValueError: if it is no DataFlash log.

    Source: ArduPilot, AP_Logger, "LogStructure.h".
    """
    reader = package("pymavlink.DFReader", DATAFLASH.kind, path)
    with reading(DATAFLASH.kind, path), silent():
        with _without_clock(reader.DFReader_binary)(str(path)) as index:
            offsets = [np.array(kind_offsets, np.int64) for kind_offsets in index.offsets]
            content = np.memmap(path, np.uint8, "r")
            formats = _formats(reader, index, offsets, content, path)
        kinds = {each[0].form.name for kind, each in formats.items() if len(offsets[kind])}
        if kinds <= {*FORMATS}:
            raise ValueError("it holds no messages but those that describe others")
    damage = _damage(formats, offsets, content)
    names = None if wanted is None else {column.partition(".")[0].partition("#")[0] for column in wanted}
    definitions = [
        (definition.form.name, kind, definition) for kind, each in formats.items() for definition in each
    ]
    for name, group in groupby(sorted(definitions, key=lambda entry: entry[0]), lambda entry: entry[0]):
        if name in FORMATS or not (names is None or name in names):
            continue
        parts: dict[str, list[tuple[Topic, np.ndarray]]] = {}
        for _, kind, definition in group:
            begins = definition.within(offsets[kind])
            begins = begins[begins + definition.form.len <= len(content)]
            for topic, topic_offsets in _instances(definition.form, content, begins) if len(begins) else ():
                parts.setdefault(topic.name, []).append((topic._replace(damage=damage), topic_offsets))
        for each in parts.values():
            yield joined(*map(list, zip(*each, strict=True)))


DATAFLASH = Format("DataFlash log", (".bin",), DATAFLASH_MAGIC, dataflash_topics)


class Definition(NamedTuple):
    """A format of a message, and the part of the file that it holds for."""

    form: Any  # pymavlink's
    begin: int  # [bytes]
    end: int

    def within(self, offsets: np.ndarray) -> np.ndarray:
        """Those of the offsets that lie in the part."""
        return offsets[(offsets >= self.begin) & (offsets < self.end)]


def _formats(
    reader: Any, index: Any, offsets: Sequence[np.ndarray], content: np.ndarray, path: Path
) -> dict[int, list[Definition]]:
    """The formats of each kind of message, in order: mostly one, more where logs were put together.

    Raises:
        ValueError: if the length of a message changes, and the package's index does not go by it.
    """
    size = len(content)
    defined: dict[int, list[tuple[int, bytes]]] = {}
    for offset in offsets[FMT].tolist():
        body = content[offset + HEADER : offset + DESCRIPTION].tobytes()
        if len(body) == DESCRIPTION - HEADER:
            each = defined.setdefault(body[0], [])
            if not each or each[-1][1] != body:
                each.append((offset, body))
    units = _units(index, offsets, content)
    definitions = {kind: [Definition(form, 0, size)] for kind, form in index.formats.items()}
    for kind, each in defined.items():
        if len(each) < 2:
            continue
        if len({body[1] for _, body in each}) > 1 and not reader.dfindexer.available:
            raise Refused(f"a DataFlash log must define a message once, but {path} defines {kind} twice")
        ends = [offset for offset, _ in each[1:]] + [size]
        definitions[kind] = []
        for (offset, body), end in zip(each, ends, strict=True):
            form = reader.DFFormat(kind, body[2:6], body[1], *(_text(body[a:b]) for a, b in ((6, 22), (22, 86))))
            for set_ids in (set_them for at, of, set_them in units if of == kind and offset < at < end):
                set_ids(form)
            begin = offset if definitions[kind] else 0
            definitions[kind].append(Definition(form, begin, end))
    return definitions


def _units(
    index: Any, offsets: Sequence[np.ndarray], content: np.ndarray
) -> list[tuple[int, int, Callable[[Any], None]]]:
    """Offset and kind of the messages that give units, and a function that sets the units of a format."""
    kind = index.name_to_id.get("FMTU")
    form = index.formats.get(kind)
    if form is None or not {"UnitIds", "MultIds"} <= set(form.colhash):
        return []
    setters: list[tuple[int, int, Callable[[Any], None]]] = []
    for offset in offsets[kind].tolist():
        body = content[offset + HEADER : offset + form.len].tobytes()
        if len(body) + HEADER < form.len:
            continue
        values = struct.unpack(form.msg_struct, body)
        ids, factors = (_text(values[form.colhash[name]]) for name in ("UnitIds", "MultIds"))

        def set_ids(form: Any, ids: str = ids, factors: str = factors) -> None:
            form.set_unit_ids(ids, index.unit_lookup)
            form.set_mult_ids(factors, index.mult_lookup)

        setters.append((offset, int(values[1]), set_ids))
    return setters


def _text(part: bytes) -> str:
    return part.partition(b"\0")[0].decode("ascii", "replace")


def _damage(
    formats: Mapping[int, Sequence[Definition]], offsets: Sequence[np.ndarray], content: np.ndarray
) -> str:
    """The parts of a log that are not read, in words; a few bytes of 0 or 255 at its end only fill a page."""
    begins, ends, unlike, unnamed = [np.empty(0, np.int64)], [np.empty(0, np.int64)], [], []
    for kind, each in formats.items():
        for form, starts in ((definition.form, definition.within(offsets[kind])) for definition in each):
            begins.append(starts)
            ends.append(starts + form.len)
            if len(offsets[kind]):
                unlike += [form.name] * (struct.calcsize(form.msg_struct) + HEADER != form.len)
                unnamed += [form.name] * (sum(map(bool, form.columns)) != len(form.format))
    order = np.argsort(np.concatenate(begins))
    begin, end = np.concatenate(begins)[order], np.concatenate(ends)[order]
    if not len(begin):
        return ""
    holes = np.append(begin[0], begin[1:] - end[:-1])
    lost, hole_count, after = int(holes[holes > 0].sum()), int((holes > 0).sum()), len(content) - int(end[-1])
    rest = set(content[len(content) - after :].tolist()) if 0 < after < LONGEST else set()
    is_rest = rest in (set(), {0}, {255})
    nameless = sum(len(kind_offsets) for kind, kind_offsets in enumerate(offsets) if kind not in formats)
    location = f"{hole_count} place{'s' * (hole_count != 1)}"
    texts = [f"{lost} bytes in {location} of the log belong to no message"] * (lost > 0)
    texts += [f"the format of {name!r} is not as long as its messages" for name in unlike]
    texts += [f"the format of {name!r} has not as many names as numbers" for name in unnamed]
    texts += [f"{nameless} messages of the log have no format"] * (nameless > 0)
    texts += ["the log is cut off: its last message is not whole"] * (after < 0)
    texts += [f"the last {after} bytes of the log belong to no message"] * (after >= LONGEST or not is_rest)
    return ", and ".join(texts)


@cache
def _without_clock(reader: type) -> type:
    """The reader, which does not look through the whole log for the date: stamps count from the start."""
    return type("Index", (reader,), {"init_clock": lambda self: None})


def _instances(form: Any, content: np.ndarray, offsets: np.ndarray) -> Iterator[tuple[Topic, np.ndarray]]:
    """The topics of a message, one per instance if it has instances, and the offsets of their rows in the file.

    Args:
        form: pymavlink's format of the message.
        content: of the file, bytes.
        offsets: of the messages (samples,).
    """
    columns, ticks = {}, None
    stamps = OF_WEEK if {*OF_WEEK, "Week"} <= {*form.columns} else STAMPS
    for name, kind, numbers in _columns(form, content, offsets):
        if name in stamps and ticks is None:
            ticks = numbers / stamps[name]
        else:
            columns[name] = numbers if kind != "a" else numbers.view("<i2").reshape(-1, 32)
    if ticks is None:
        yield Topic(form.name, None, {}, unread={"": "messages without times"}), offsets
        return
    units = {name: unit for name, unit in zip(form.columns, form.units or (), strict=False) if unit}
    units = {name: UNITS_OF_ARDUPILOT.get(unit, unit) for name, unit in units.items()}
    which = columns.get(form.instance_field, np.zeros(len(ticks), int))
    for number in np.unique(which):
        in_instance = which == number
        fields = {
            key: column
            for name, values in columns.items()
            for key, column in columns_of(name, values[in_instance]).items()
        }
        name = f"{form.name}#{number:g}" if number else form.name
        field_units = {key: units.get(key.partition("[")[0], "") for key in fields}
        yield Topic(name, ticks[in_instance], fields, field_units), offsets[in_instance]


def _columns(form: Any, content: np.ndarray, offsets: np.ndarray) -> Iterator[tuple[str, str, np.ndarray]]:
    """Name, ArduPilot's kind and numbers (samples,) of each column of a message that holds numbers."""
    offset = HEADER
    for name, kind in zip(form.columns, form.format, strict=False):
        if kind in TEXTS:
            offset += TEXTS[kind]
            continue
        stored, divisor = np.dtype(NUMBERS[kind][0]), NUMBERS[kind][1]
        offset += stored.itemsize
        if offset > form.len:
            return
        at = offsets + (offset - stored.itemsize)
        bytewise = np.ndarray((len(content) - stored.itemsize + 1,), stored, content, strides=(1,))
        numbers = bytewise[at]
        yield name, kind, numbers if divisor == 1.0 else numbers / divisor


ULOG_MAGIC = b"ULog\x01\x12\x35"
STAMP = "timestamp"
TICKS = 1e6  # a second
UNITS_OF_PX4 = {  # of fields of PX4's messages whose names have none that headers have, or another one
    **{"gyro_rad": "rad/s", "discharged_mah": "mA*h", "magnetometer_ga": "gauss"},
    **dict.fromkeys(("voltage_v", "voltage_filtered_v", "voltage5v_v", "esc_voltage"), "V"),
    **dict.fromkeys(("current_a", "current_filtered_a", "current_average_a", "esc_current"), "A"),
    **dict.fromkeys(("baro_pressure_pa", "differential_pressure_pa", "differential_pressure_filtered_pa"), "Pa"),
    **dict.fromkeys(("baro_temp_celcius", "air_temperature_celsius", "esc_temperature"), "degC"),
}
START = 16  # bytes before the first message
LONGEST_UNKNOWN = 10_000  # bytes of a message of a kind that is not known
SEVERAL = 4  # messages that follow one another: none begin by chance
APPENDED = struct.pack("<HB", 40, ord("B")) + bytes(8) + b"\1"  # flags of a log to which data were appended
FORMAT, SUBSCRIPTION = b"FA"
KINDS = b"ABCDFILMOPQRS"  # of messages
TEXT_KINDS, LEVELS = (
    b"LC",
    (*(bytes([level]) for level in b"01234567"),),
)  # messages of text, and what they begin with


def ulog_topics(path: Path, wanted: Wanted = None) -> Iterator[Topic]:
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
    core = package("pyulog.core", ULOG.kind, path)
    names = None if wanted is None else sorted({column.partition(".")[0].partition("#")[0] for column in wanted})
    with reading(ULOG.kind, path), silent():
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


ULOG = Format("ULog", (".ulg", ".ulog"), ULOG_MAGIC, ulog_topics, has_units=False)


def _topic(name: str, data: Any, damage: str) -> Topic:
    if STAMP not in data.data:
        return Topic(name, None, {}, unread={"": "messages without times"})
    kinds = {field.field_name: field.type_str for field in data.field_data}
    numbers = _numbers(data.data, kinds)
    known = {field: UNITS_OF_PX4.get(field.rpartition(".")[2].partition("[")[0], "") for field in numbers}
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
        return end if kind and 0 < count <= LONGEST_UNKNOWN and follows else None
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
            is_text = kind not in TEXT_KINDS or content[begin : begin + 1] in LEVELS
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
