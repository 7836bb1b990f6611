"""Bags of ROS 1 and ROS 2, also as MCAP, by the package rosbags, with one clock for all topics of a log.

Stamps of headers are exact, but they may have the time of a device or a simulation, and topics without stamps have
only times of reception: of two such topics nobody knows which samples belong together. So a log has the stamps of
headers if all topics have them on one clock, and otherwise the times of reception.
"""

from __future__ import annotations

import re
from array import array
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from keyword import iskeyword
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from thruster_env.logs.recorders.bag_counts import (
    DB3,
    MCAP,
    REPAIRS,
    ROS1,
    Bag,
    Counts,
    counts_of,
    files_of,
    is_ros1,
    unpacker,
)
from thruster_env.logs.recorders.topics import (
    HEADER_TYPE,
    MOST_COLUMNS,
    MOST_FIELDS,
    STAMPED,
    Format,
    Pairs,
    Refused,
    Topic,
    Wanted,
    bounded,
    check_bytes,
    package,
    reading,
    wants,
)

HEADER, RECEIPT = "header", "receipt"
STAMPS = (HEADER, RECEIPT)
APART = 60.0  # [s] between the clocks of two headers: less may be the delay of a message
FEWEST = 3  # messages of a topic whose clock is compared: one that is sent once may be old

# Of messages.
KIND = "bag"
TICKS = 1e9  # a second
NUMBER = re.compile(r"bool|byte|char|u?int\d+|float(32|64)")
NAME = re.compile(r"[A-Za-z]\w*(/\w+)*", re.ASCII)  # of a type or a field
DEEPEST = 8  # messages within messages


class Clocked(NamedTuple):
    """The times of a topic's messages, in order of `times`."""

    clock: str  # HEADER or RECEIPT; empty for a format that has no such choice
    times: np.ndarray  # (samples,) [s]
    received: np.ndarray | None  # (samples,) [s]; None where the times are these

    @property
    def order(self) -> np.ndarray:
        """Indices of the messages in the order of reception."""
        return np.argsort(self.times if self.received is None else self.received, kind="stable")


class Choice(NamedTuple):
    """The clock of a log, and why it is not that of the headers; empty where no topic has stamps in headers."""

    clock: str
    why: str


def chosen_clock(topics: Mapping[str, Clocked], asked: str | None, path: Path) -> Choice:
    """The clock of some topics, by name.

    Args:
        topics: those of a log.
        asked: HEADER or RECEIPT; None for HEADER if all topics have stamps of one clock, else RECEIPT.
        path: of the file, for messages.

    Raises:
        ValueError: if the stamps of headers are asked for, and a topic has none.
    """
    without = [name for name, topic in topics.items() if topic.clock == RECEIPT]
    if asked == HEADER and without:
        rule = "stamps must be in the headers of all topics of a log"
        raise ValueError(f"{rule}, but {without[0]} of {path} has none (use --stamps receipt)")
    if asked is not None:
        return Choice(asked, "")
    if len(without) == len(topics):
        return Choice(RECEIPT if without else "", "")
    if without:
        return Choice(RECEIPT, f"{without[0]} has no stamps in headers")
    other = _of_another_clock(topics)
    return Choice(RECEIPT, f"the headers of {other} have another clock") if other else Choice(HEADER, "")


def _of_another_clock(topics: Mapping[str, Clocked]) -> str:
    """The first topic whose headers are not on the clock of those of the longest topic; empty if there is none.

    How far a clock is ahead of reception is compared at the same times of reception, because simulated time may
    run at another rate.
    """
    longest = max(topics.values(), key=lambda topic: len(topic.times))
    if longest.received is None or len(longest.times) < FEWEST:
        return ""
    received = longest.received[longest.order]
    ahead = longest.times[longest.order] - received
    for name, topic in topics.items():
        if topic.received is not None and len(topic.times) >= FEWEST:
            apart = topic.times - topic.received - np.interp(topic.received, received, ahead)
            if np.median(abs(apart)) > APART:
                return name
    return ""


class Leaf(NamedTuple):
    """A field of a message that holds a number or an array of them."""

    path: str  # "pose.position.x"
    is_array: bool
    why: str = ""  # it is not read


def topics(path: Path, wanted: Wanted = None) -> Iterator[Topic]:
    """The topics of a bag: times are the stamps of the messages' headers, else when the messages were received.

    Times are [s] since the bag's first message was received; a topic has those of headers if these have stamps: 0
    is one only at the beginning, where simulated time begins. It has the times of reception, too. Fields are
    numbers and short arrays, of which each message has as many; a bag has no units. Types come from the bag, or
    where it has none from the newest release of ROS 2 that the package knows. If a topic has several, its messages
    are matched by the names of fields; a field is NaN in messages without it. An array of transforms (/tf) is a
    topic for each pair of frames, TOPIC/PARENT/CHILD, with the stamps of its own headers.

    Args:
        path: of a .bag, .db3 or .mcap file, or of the folder of a bag of ROS 2.
        wanted: columns whose topics are read; None for all.

    Raises:
        ValueError: if it is no bag, or has not as many messages as it says.

    Source: ROS, "Bag File Format 2.0"; Foxglove, "MCAP".
    """
    contents = Contents(path, wanted)
    with reading(KIND, path), bounded("a bag", path), files_of(path, KIND) as bag:
        for file in bag.files:
            contents.add(file, bag.is_packed)
        contents.check(bag)
        begin = bag.begin if bag.begin is not None else contents.begin
    for name in sorted({*contents.samples, *contents.unread}):
        yield _topic(name, [*contents.samples.get(name, {}).values()], begin, contents.unread.get(name, {}))


def wants_pairs(wanted: Wanted, topic: str) -> bool:
    """Whether a column is wanted that may belong to a pair of frames of a topic."""
    return wanted is not None and any(column.startswith(f"{topic}/") for column in wanted)


def check_counts(read: Counts, topics: Mapping[int, str], stated: Mapping[str, Counts], path: Path) -> None:
    """Raise Refused unless as many messages were read as the file states.

    Args:
        read: messages of those connections that were read.
        topics: names of all connections.
        stated: from `counts_of`.
        path: of the file, for messages.
    """
    for source, counts in stated.items():
        for connection, count in read.items():
            if count != counts.get(connection, 0):
                raise _lost(repr(topics[connection]), count, counts.get(connection, 0), source, path)
        nameless = sum(count for connection, count in counts.items() if connection not in topics)
        if nameless:
            raise _lost("a topic without a name", 0, nameless, source, path)


def _lost(topic: str, read: int, stated: int, source: str, path: Path) -> Refused:
    suffix = {".bag": ROS1, ".mcap": MCAP}.get(path.suffix.lower(), DB3)
    return Refused(
        f"a bag must hold the messages that it says it has, but {topic} has {read} of {stated} by its {source} "
        f"({path}): it is damaged; repair it, as with {REPAIRS[suffix]}"
    )


def check_topics(read: Counts | Mapping[str, int], stated: Mapping[str, int], known: set[str], path: Path) -> None:
    """Raise Refused unless the files of a bag hold as many messages of each topic as its metadata.yaml says.

    Args:
        read: messages by topic, of those that were read.
        stated: messages by topic, by the metadata.
        known: topics that the files have.
        path: of the bag, for messages.
    """
    for topic, count in stated.items():
        count_read = read.get(topic, 0)  # type: ignore[call-overload]
        if count_read != count and (topic in read or topic not in known):
            raise _lost(repr(topic), count_read, count, "metadata.yaml", path)


class Contents:
    """The samples of a bag, read file by file.

    Attributes:
        samples: the numbers of a topic by the leaves of its messages, by topic.
        unread: why a field is not read, by topic and field.
        begin: when the first message was received [ns].
    """

    def __init__(self, path: Path, wanted: Wanted):
        self.path, self._wanted, self._is_ros1 = path, wanted, is_ros1(path)
        self._room = package("rosbags.rosbag1" if self._is_ros1 else "rosbags.rosbag2", KIND, path)
        self._types = package("rosbags.typesys", KIND, path)
        self.samples: dict[str, dict[tuple[Leaf, ...], Samples]] = {}
        self.unread: dict[str, dict[str, str]] = {}
        self.begin = 0
        self._pairs = Pairs(path)
        self._size, self._known, self._counts = 0, set[str](), Counter[str]()

    def add(self, file: Path, is_packed: bool) -> None:
        """Read the messages of a file; ValueError unless it has as many as it says."""
        stated = counts_of(file)
        with self._room.Reader(file) as reader:
            names = {connection.id: connection.topic for connection in reader.connections}
            if len(names) < len(reader.connections):
                raise ValueError("it has two connections of one number")
            decoders = dict(self._decoders(reader.connections))
            readable = {number for number, decoder in decoders.items() if decoder.leaves}
            chosen = [connection for connection in reader.connections if connection.id in readable]
            rows = Counter({connection.id: 0 for connection in chosen})
            unpack = unpacker(KIND, self.path).decompress if is_packed else bytes
            for connection, received, data in reader.messages(chosen) if chosen else ():
                decoder = decoders[connection.id]
                rows[connection.id] += 1
                for topic, stamp, row in decoder.read(unpack(data)):
                    if not wants(self._wanted, topic):
                        continue
                    parts = self.samples.setdefault(topic, {})
                    if decoder.leaves not in parts:
                        parts[decoder.leaves] = Samples(decoder.leaves)
                    self._size += 8 * parts[decoder.leaves].add(received, stamp, row)
                    check_bytes(self._size, "the numbers of a bag", self.path)
            if reader.message_count:
                self.begin = min(self.begin or reader.start_time, reader.start_time)
        check_counts(rows, names, stated, self.path)
        for number, decoder in decoders.items():
            self.unread.setdefault(names[number], {}).update(decoder.unread)
        self._known |= set(names.values())
        for number, count in rows.items():
            self._counts[names[number]] += count

    def _decoders(self, connections: Sequence[Any]) -> Iterator[tuple[int, Decoder]]:
        """Decoders of the connections that are wanted, by number."""
        for connection in connections:
            is_wanted = wants(self._wanted, connection.topic)
            if is_wanted or wants_pairs(self._wanted, connection.topic):
                decoder = Decoder(self._types, connection, self._is_ros1, self._pairs)
                if is_wanted or decoder.transforms:
                    yield connection.id, decoder

    def check(self, bag: Bag) -> None:
        """Raise ValueError unless the files have as many messages of each topic as a bag's metadata states.

        Nor may a pair of frames have the name of a topic.
        """
        self._pairs.check(self._known)
        check_topics(self._counts, bag.counts, self._known, self.path)


def array_of_transforms(defined: dict, kind: str) -> str:
    """The only field of a type of messages, if it is an array of transforms; empty for other types.

    Source: ROS, tf2_msgs/TFMessage, tf/tfMessage, geometry_msgs/TransformStamped.
    """
    fields: Sequence[Any] = defined[kind][1] if kind in defined else ()
    if len(fields) != 1 or not _has_frames(dict(defined.get(STAMPED, ((), ()))[1]), defined):
        return ""
    ((name, (node, what)),) = fields
    is_array = node.name in ("ARRAY", "SEQUENCE") and what[0][0].name == "NAME"
    return name if is_array and what[0][1] == STAMPED else ""


def _has_frames(fields: Mapping, defined: dict) -> bool:
    """Whether a message has a header, the child's frame and a transform, and nothing else."""
    if set(fields) != {"header", "child_frame_id", "transform"}:
        return False
    child, (node, transform) = fields["child_frame_id"], fields["transform"]
    is_text = child[0].name == "BASE" and child[1][0] == "string"
    return fields["header"][1] == HEADER_TYPE and is_text and node.name == "NAME" and transform in defined


class Decoder:
    """Numbers of the messages of one connection.

    Attributes:
        leaves: the fields that hold numbers, of a transform where messages are arrays of them.
        unread: why others are not read, by path.
        transforms: the field that is an array of transforms; empty for messages that are one row each.
    """

    def __init__(self, types: Any, connection: Any, is_ros1: bool, pairs: Pairs):
        store = types.get_typestore(types.Stores.EMPTY)
        text, kind = connection.msgdef.data, connection.msgtype
        if text:
            is_idl = connection.msgdef.format.name == "IDL"
            defined = types.get_types_from_idl(text) if is_idl else types.get_types_from_msg(text, kind)
            _check_types(defined)
            store.register(defined)
        elif not is_ros1:
            store = types.get_typestore(types.Stores.LATEST)
        self.transforms = array_of_transforms(store.fielddefs, kind)
        row = dict(store.fielddefs[STAMPED][1])["transform"][1] if self.transforms else kind
        every = [*_leaves(store.fielddefs, row)] if kind in store.fielddefs else []
        self.leaves = tuple(leaf for leaf in every if not leaf.why)
        self.unread = {leaf.path: leaf.why for leaf in every if leaf.why}
        encoding = "cdr" if is_ros1 else connection.ext.serialization_format
        if kind not in store.fielddefs or encoding != "cdr":
            what = f"messages of the type {kind[:80]}, which is not known"
            self.leaves, self.unread = (), {"": what if encoding == "cdr" else f"messages as {encoding[:80]}"}
        read = store.deserialize_ros1 if is_ros1 else store.deserialize_cdr
        self._message = lambda data: read(data, kind)
        self._fields = attrgetter(*(leaf.path for leaf in self.leaves), "__class__") if self.leaves else None
        fields = dict(store.fielddefs.get(kind, ((), ()))[1])
        self._has_header = "header" in fields and fields["header"][1] == HEADER_TYPE
        self._topic, self._pairs = connection.topic, pairs

    def read(self, data: bytes) -> Iterator[tuple[str, int, tuple]]:
        """For each row of a message: topic, the header's stamp [ns] (0 without one) and the leaves' values."""
        message = self._message(data)
        assert self._fields is not None
        if not self.transforms:
            yield self._topic, _stamp(message) if self._has_header else 0, self._fields(message)[:-1]
            return
        for topic, transform in self._pairs.topics(self._topic, getattr(message, self.transforms)):
            yield topic, _stamp(transform), self._fields(transform.transform)[:-1]


class Samples:
    """The numbers of a topic, as they come."""

    def __init__(self, leaves: Sequence[Leaf]):
        self.leaves = leaves
        self.received, self.stamps = array("q"), array("q")
        self.numbers = [array("d") for _ in leaves]
        self.widths: list[int | None] = [None] * len(leaves)  # entries of an array; -1 where they differ

    def add(self, received: int, stamp: int, row: tuple) -> int:
        """Add a message, received and stamped at some time [ns]; return how many numbers it adds."""
        first, count = not self.received, 2
        self.received.append(received)
        self.stamps.append(stamp)
        for index, (leaf, value) in enumerate(zip(self.leaves, row, strict=True)):
            if not leaf.is_array:
                self.numbers[index].append(value)
                count += 1
            elif first or self.widths[index] == len(value):
                self.widths[index] = len(value)
                if len(value) <= MOST_COLUMNS:
                    self.numbers[index].extend(value)
                    count += len(value)
            else:
                self.widths[index] = -1
                del self.numbers[index][:]
        return count

    def columns(self) -> tuple[dict[str, np.ndarray], dict[str, str]]:
        """The numbers of each field (messages,), in the order of messages, and why an array is not read."""
        values: dict[str, np.ndarray] = {}
        unread: dict[str, str] = {}
        for leaf, numbers, width in zip(self.leaves, self.numbers, self.widths, strict=True):
            if not leaf.is_array:
                values[leaf.path] = np.array(numbers)
            elif width is not None and 0 < width <= MOST_COLUMNS:
                rows = np.array(numbers).reshape(-1, width)
                values |= {f"{leaf.path}[{entry}]": rows[:, entry] for entry in range(width)}
            elif width:
                what = "whose length changes" if width < 0 else f"of {width} entries"
                unread[leaf.path] = f"an array {what}"
        return values, unread


def _stamp(message: Any) -> int:
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


def _are_set(stamps: np.ndarray) -> bool:
    """Whether headers have stamps; 0 stands where there is none, and at the beginning of simulated time."""
    nothing = np.flatnonzero(stamps == 0)
    return len(nothing) < len(stamps) and bool((nothing == np.arange(len(nothing))).all())


def _topic(name: str, parts: Sequence[Samples], begin: int, unread: Mapping[str, str]) -> Topic:
    """A topic whose messages are of one type or several, in order of their times [s] since the beginning [ns]."""
    stamps = np.concatenate([np.empty(0, np.int64), *(np.array(part.stamps, np.int64) for part in parts)])
    received = np.concatenate([np.empty(0, np.int64), *(np.array(part.received, np.int64) for part in parts)])
    has_stamps = _are_set(stamps[np.argsort(received, kind="stable")])
    ticks = stamps if has_stamps else received
    order = np.argsort(ticks, kind="stable")
    values: dict[str, np.ndarray] = {}
    unread, row = dict(unread), 0
    for part in parts:
        columns, skipped = part.columns()
        unread |= skipped
        for field, numbers in columns.items():
            values.setdefault(field, np.full(len(ticks), np.nan))[row : row + len(numbers)] = numbers
        row += len(part.received)
    times, received = ((instants[order] - begin) / TICKS for instants in (ticks, received))
    values = {key: column[order] for key, column in values.items()}
    clock = (HEADER, received) if has_stamps else (RECEIPT, None)
    return Topic(name, times, values, unread=unread, clock=clock[0], received=clock[1])


def _leaves(defined: dict, kind: str, before: str = "", depth: int = 0) -> Iterator[Leaf]:
    """Fields of a message of a type that hold numbers or arrays of messages, not those of its header."""
    for name, (node, what) in defined[kind][1]:
        path = before + (f"{name}_" if iskeyword(name) else name)
        if node.name == "BASE" and NUMBER.fullmatch(what[0]):
            yield Leaf(path, False)
        elif node.name == "NAME" and what != HEADER_TYPE and what in defined and depth < DEEPEST:
            yield from _leaves(defined, what, f"{path}.", depth + 1)
        elif node.name in ("ARRAY", "SEQUENCE"):
            (inner, base), size = what
            if inner.name == "NAME":
                yield Leaf(path, True, "an array of messages")
            elif NUMBER.fullmatch(base[0]):
                is_long = node.name == "ARRAY" and size > MOST_COLUMNS
                yield Leaf(path, True, f"an array of {size} entries" if is_long else "")


def _check_types(defined: dict) -> None:
    """Raise ValueError unless types that a bag defines are names and sizes, for classes are made of them.

    Nor may an array hold messages without numbers, of which any count fits into a few bytes.
    """
    for kind, (constants, fields) in defined.items():
        names = [kind, *(entry[0] for entry in constants), *(entry[0] for entry in fields)]
        arrays = [what for _, (node, what) in fields if node.name in ("ARRAY", "SEQUENCE")]
        sound = [
            all(isinstance(constant[2], (bool, int, float, str)) for constant in constants),
            all(map(NAME.fullmatch, names)) and len(names) <= MOST_FIELDS,
            max((what[1] for _, (node, what) in fields if node.name == "ARRAY"), default=0) <= MOST_FIELDS,
            not any(inner.name == "NAME" and _is_void(defined, what) for (inner, what), _ in arrays),
        ]
        if not all(sound):
            raise ValueError(f"the type {kind[:80]!r} is none of a message")


def _is_void(defined: dict, kind: str, depth: int = 0) -> bool:
    """Whether a message of a type takes no bytes."""
    if kind not in defined or depth > DEEPEST:
        return False
    return all(node.name == "NAME" and _is_void(defined, what, depth + 1) for _, (node, what) in defined[kind][1])


ROS1_BAG = Format("bag of ROS 1", (".bag",), ROS1, topics, has_receipt=True)
MCAP_FILE = Format("MCAP file", (".mcap",), MCAP, topics, has_receipt=True)
ROS2_BAG = Format("bag of ROS 2", (".db3",), DB3, topics, has_receipt=True)
