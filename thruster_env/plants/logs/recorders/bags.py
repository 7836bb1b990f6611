"""Bags of ROS 1 and ROS 2, also as MCAP, by the package rosbags."""

from __future__ import annotations

import re
from array import array
from collections.abc import Iterator
from keyword import iskeyword
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from thruster_env.plants.logs.recorders.topics import (
    MOST_COLUMNS,
    MOST_FIELDS,
    Topic,
    Wanted,
    bounded,
    check_bytes,
    package,
    reading,
    wants,
)

KIND = "bag"
ROS1, MCAP, DB3 = b"#ROSBAG V2.0", b"\x89MCAP0\r\n", b"SQLite format 3\x00"
DATABASE = ".db3"
TICKS = 1e9  # a second
NUMBER = re.compile(r"bool|byte|char|u?int\d+|float(32|64)")
NAME = re.compile(r"[A-Za-z]\w*(/\w+)*", re.ASCII)  # of a type or a field
HEADER = "std_msgs/msg/Header"
DEEPEST = 8  # messages within messages


class Leaf(NamedTuple):
    """A field of a message that holds a number or an array of them."""

    path: str  # "pose.position.x"
    is_array: bool


def topics(path: Path, wanted: Wanted = None) -> Iterator[Topic]:
    """The topics of a bag: times are the stamps of the messages' headers, else when the messages were received.

    Times are [s] since the bag's first message was received; a topic has those of headers if all its messages have
    one that is not 0. Fields are numbers and short arrays, of which each message has as many; a bag has no units.
    Types come from the bag, or where it has none from the newest release of ROS 2 that the package knows.

    Args:
        path: of a .bag, .db3 or .mcap file, or of the folder of a bag of ROS 2.
        wanted: columns whose topics are read; None for all.

    Raises:
        ValueError: if it is no bag.

    Source: ROS, "Bag File Format 2.0"; Foxglove, "MCAP".
    """
    room = package("rosbags.rosbag1" if path.suffix.lower() == ".bag" else "rosbags.rosbag2", KIND, path)
    types = package("rosbags.typesys", KIND, path)
    found: dict[str, Samples] = {}
    with reading(KIND, path), bounded("a bag", path), room.Reader(path) as reader:
        for file in sorted(path.glob(f"*{DATABASE}")) if path.is_dir() else [path]:
            _check_whole(file)
        some = [one for one in reader.connections if wants(wanted, one.topic)]
        kinds = {one.id: Decoder(types, one, path.suffix.lower() == ".bag") for one in some}
        some = [one for one in some if kinds[one.id].leaves]
        begin, size = reader.start_time, 0
        for connection, received, data in reader.messages(some) if some else ():
            decoder = kinds[connection.id]
            stamp, row = decoder.read(data)
            size += 8 * (len(row) + 2)
            check_bytes(size, "the numbers of a bag", path)
            found.setdefault(connection.topic, Samples(decoder.leaves)).add(received, stamp, row)
    for name in sorted(found):
        yield found[name].topic(name, begin)


class Decoder:
    """Numbers of the messages of one type."""

    def __init__(self, types: Any, connection: Any, is_ros1: bool):
        """Find the fields that hold numbers; none for a type that is not known."""
        store = types.get_typestore(types.Stores.EMPTY)
        text, kind = connection.msgdef.data, connection.msgtype
        if text:
            is_idl = connection.msgdef.format.name == "IDL"
            defined = types.get_types_from_idl(text) if is_idl else types.get_types_from_msg(text, kind)
            _check_types(defined)
            store.register(defined)
        elif not is_ros1:
            store = types.get_typestore(types.Stores.LATEST)
        self.leaves = list(_leaves(store.fielddefs, kind)) if kind in store.fielddefs else []
        read = store.deserialize_ros1 if is_ros1 else store.deserialize_cdr
        self._message = lambda data: read(data, kind)
        self._fields = attrgetter(*(one.path for one in self.leaves), "__class__") if self.leaves else None
        fields = dict(store.fielddefs.get(kind, ((), ()))[1])
        self._has_header = "header" in fields and fields["header"][1] == HEADER

    def read(self, data: bytes) -> tuple[int, tuple]:
        """The header's stamp [ns], 0 where there is none, and what each leaf holds."""
        message = self._message(data)
        stamp = message.header.stamp if self._has_header else None
        assert self._fields is not None
        return (0 if stamp is None else stamp.sec * 10**9 + stamp.nanosec), self._fields(message)[:-1]


class Samples:
    """The numbers of a topic, as they come."""

    def __init__(self, leaves: list[Leaf]):
        """Nothing is there yet."""
        self.leaves = leaves
        self.received, self.stamps = array("q"), array("q")
        self.numbers = [array("d") for _ in leaves]
        self.widths: list[int | None] = [None] * len(leaves)  # entries of an array; -1 where they differ

    def add(self, received: int, stamp: int, row: tuple) -> None:
        """Add a message, received and stamped at some time [ns]."""
        first = not self.received
        self.received.append(received)
        self.stamps.append(stamp)
        for place, (leaf, value) in enumerate(zip(self.leaves, row, strict=True)):
            if not leaf.is_array:
                self.numbers[place].append(value)
            elif first or self.widths[place] == len(value):
                self.widths[place] = len(value)
                if len(value) <= MOST_COLUMNS:
                    self.numbers[place].extend(value)
            else:
                self.widths[place] = -1
                del self.numbers[place][:]

    def topic(self, name: str, begin: int) -> Topic:
        """Fields of all messages, in order of their times [s] since the beginning [ns]."""
        ticks = np.array(self.stamps if all(self.stamps) else self.received, np.int64)
        order = np.argsort(ticks, kind="stable")
        values: dict[str, np.ndarray] = {}
        for leaf, numbers, width in zip(self.leaves, self.numbers, self.widths, strict=True):
            if not leaf.is_array:
                values[leaf.path] = np.array(numbers)[order]
            elif width is not None and 0 < width <= MOST_COLUMNS:
                rows = np.array(numbers).reshape(-1, width)[order]
                values |= {f"{leaf.path}[{entry}]": rows[:, entry] for entry in range(width)}
        return Topic(name, (ticks[order] - begin) / TICKS, values)


def _check_whole(path: Path) -> None:
    """Raise ValueError for a database of SQLite that has fewer pages than it says; SQLite reads what is left."""
    with path.open("rb") as file:
        head = file.read(100)
    if head.startswith(DB3) and head[24:28] == head[92:96]:  # the count of pages is that of the last change
        page = int.from_bytes(head[16:18]) or 1
        count = int.from_bytes(head[28:32])
        if path.stat().st_size < count * (page if page > 1 else 65536):
            raise ValueError(f"{path.name} is cut off")


def _leaves(defined: dict, kind: str, before: str = "", depth: int = 0) -> Iterator[Leaf]:
    """Fields of a message of a type that hold numbers, those of messages in it included; not its header."""
    for name, (node, what) in defined[kind][1]:
        path = before + (f"{name}_" if iskeyword(name) else name)
        if node.name == "BASE" and NUMBER.fullmatch(what[0]):
            yield Leaf(path, False)
        elif node.name == "NAME" and what != HEADER and what in defined and depth < DEEPEST:
            yield from _leaves(defined, what, f"{path}.", depth + 1)
        elif node.name in ("ARRAY", "SEQUENCE"):
            (inner, base), size = what
            if (
                inner.name == "BASE"
                and NUMBER.fullmatch(base[0])
                and (node.name == "SEQUENCE" or size <= MOST_COLUMNS)
            ):
                yield Leaf(path, True)


def _check_types(defined: dict) -> None:
    """Raise ValueError unless types that a bag defines are names and sizes, for classes are made of them.

    Nor may an array hold messages without numbers, of which any count fits into a few bytes.
    """
    for kind, (constants, fields) in defined.items():
        names = [kind, *(one[0] for one in constants), *(one[0] for one in fields)]
        arrays = [what for _, (node, what) in fields if node.name in ("ARRAY", "SEQUENCE")]
        sound = [
            all(isinstance(one[2], (bool, int, float, str)) for one in constants),
            all(map(NAME.fullmatch, names)) and len(names) <= MOST_FIELDS,
            max((what[1] for _, (node, what) in fields if node.name == "ARRAY"), default=0) <= MOST_FIELDS,
            not any(inner.name == "NAME" and _is_void(defined, one) for (inner, one), _ in arrays),
        ]
        if not all(sound):
            raise ValueError(f"the type {kind[:80]!r} is none of a message")


def _is_void(defined: dict, kind: str, depth: int = 0) -> bool:
    """Whether a message of a type takes no bytes."""
    if kind not in defined or depth > DEEPEST:
        return False
    return all(node.name == "NAME" and _is_void(defined, what, depth + 1) for _, (node, what) in defined[kind][1])
