"""The files of a bag, and the number of messages that it states: a damaged bag has another."""

from __future__ import annotations

import sqlite3
import struct
import sys
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path, PurePath
from tempfile import TemporaryDirectory
from typing import Any, BinaryIO, NamedTuple
from urllib.parse import quote

from thruster_env.logs.recorders import topics
from thruster_env.logs.recorders.topics import Refused, check_bytes, package

ROS1, MCAP, DB3 = b"#ROSBAG V2.0", b"\x89MCAP0\r\n", b"SQLite format 3\x00"
REPAIRS = {ROS1: "rosbag reindex", MCAP: "mcap recover", DB3: "ros2 bag reindex"}  # the formats' own programs
SCHEMA, CHANNEL, MESSAGE, CHUNK, INDEX = 3, 4, 5, 6, 7  # records of an MCAP file
CHUNK_INDEX, STATISTICS, DATA_END, FOOTER = 8, 11, 15, 2
ROS1_HEADER, ROS1_INDEX, ROS1_CHUNK, ROS1_CHUNK_INFO, ROS1_CONNECTION = 3, 4, 5, 6, 7  # those of a bag of ROS 1
PIECE = 2**20  # bytes

Counts = Mapping[int, int]  # messages by connection

# Of the metadata.
METADATA = "metadata.yaml"
NEWEST = 9  # version of the metadata
PACKED = ("", "none", "file", "message")


def is_ros1(path: Path) -> bool:
    """Whether a file is a bag of ROS 1, by its first bytes."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(len(ROS1)) == ROS1


def counts_of(path: Path) -> dict[str, Counts]:
    """The stated numbers of messages in a file of a bag, by source of the statement and by connection.

    Args:
        path: of a .bag, .db3 or .mcap file.

    Raises:
        ValueError: for a file whose parts are not all there, or contradict one another.

    Source: ROS, "Bag File Format 2.0"; Foxglove, "MCAP Format Specification".
    """
    with path.open("rb") as file:
        first = file.read(len(DB3))
        if first.startswith(ROS1):
            return _of_ros1(file, path)
        if first.startswith(MCAP):
            return _of_mcap(file, path)
    if first == DB3:
        _check_whole(path)
        return _of_database(path)
    raise ValueError(f"it begins with {first[:8]!r}")


def _of_mcap(file: BinaryIO, path: Path) -> dict[str, Counts]:
    size = path.stat().st_size
    alone, indexed, statistics, described = Counter[int](), Counter[int](), None, None
    records: Counter[int] = Counter()
    channels: dict[int, bytes] = {}
    offset = len(MCAP)
    while True:
        file.seek(offset)
        kind, count = struct.unpack("<BQ", _exact(file, 9))
        if offset + 9 + count > size:
            raise ValueError("it ends within a record")
        records[kind] += 1
        if kind == MESSAGE:
            alone[struct.unpack("<H", _exact(file, 2))[0]] += 1
        elif kind == CHUNK:
            check_bytes(struct.unpack("<QQQ", _exact(file, 24))[2], "a chunk of an MCAP file", path)
        elif kind == INDEX:
            channel, length = struct.unpack("<HI", _exact(file, 6))
            indexed[channel] += length // 16
        elif kind == CHANNEL:
            content = _exact(file, count)
            if channels.setdefault(int.from_bytes(content[:2], "little"), content) != content:
                raise ValueError("it defines a channel twice")
        elif kind == STATISTICS:
            content = _exact(file, count)
            statistics, described = _statistics(content), struct.unpack_from("<HI", content, 8)
        elif kind == DATA_END:
            _check_sum(file, 0, offset, struct.unpack("<I", _exact(file, 4))[0], "data")
        elif kind == FOOTER:
            summary, _, check = struct.unpack("<QQI", _exact(file, 20))
            if summary:
                _check_sum(file, summary, offset + 25, check, "summary")
            break
        offset += 9 + count
    schemas, named = described or (records[SCHEMA], records[CHANNEL])
    if records[CHUNK] and (records[SCHEMA] < min(schemas, 1) or records[CHANNEL] < named):
        rule = "an MCAP file must have its schemas and channels in its summary"
        raise Refused(f"{rule}, but {path} has them in its chunks alone: mcap recover writes one that is read")
    if records[CHUNK_INDEX] and records[CHUNK_INDEX] != records[CHUNK]:
        raise ValueError(f"it has {records[CHUNK]} chunks, but an index of {records[CHUNK_INDEX]}")
    if records[CHUNK] and records[CHUNK_INDEX] and not records[INDEX] and statistics != {}:
        raise ValueError("its chunks have no index of their messages")
    counts: dict[str, Counts] = {} if statistics is None else {"statistics": statistics}
    if records[INDEX] or not records[CHUNK]:
        counts["records"] = indexed + alone
    return counts


def _statistics(content: bytes) -> dict[int, int]:
    """Messages by channel; ValueError unless their sum is the stated total."""
    total, length = struct.unpack_from("<Q", content)[0], struct.unpack_from("<I", content, 42)[0]
    if 46 + length > len(content) or length % 10:
        raise ValueError("its statistics are damaged")
    counts = dict(struct.iter_unpack("<HQ", content[46 : 46 + length]))
    if sum(counts.values()) != total:
        raise ValueError(f"its statistics say {total} messages, but {sum(counts.values())} by channel")
    return counts


def _check_sum(file: BinaryIO, begin: int, end: int, check: int, what: str) -> None:
    """Raise ValueError unless the bytes of a part have its check sum (CRC-32); 0 stands for none."""
    if not check:
        return
    file.seek(begin)
    computed, left = 0, end - begin
    while left > 0 and (piece := file.read(min(left, PIECE))):
        computed, left = zlib.crc32(piece, computed), left - len(piece)
    if computed != check:
        raise ValueError(f"the check sum of its {what} is wrong")


def _of_ros1(file: BinaryIO, path: Path) -> dict[str, Counts]:
    size, offset = path.stat().st_size, file.seek(len(ROS1) + 1)
    index, chunks = Counter[int](), Counter[int]()
    records: Counter[int] = Counter()
    stated, begin = (0, 0), 0
    while offset < size:
        header = _fields(_exact(file, struct.unpack("<I", _exact(file, 4))[0]))
        (count,) = struct.unpack("<I", _exact(file, 4))
        offset = file.tell()
        kind = header[b"op"][0]
        if kind == ROS1_HEADER:
            begin = int.from_bytes(header[b"index_pos"], "little")
            stated = _number(header, b"conn_count"), _number(header, b"chunk_count")
        elif kind == ROS1_INDEX:
            index[_number(header, b"conn")] += _number(header, b"count")
        elif kind == ROS1_CHUNK:
            check_bytes(_number(header, b"size"), "a chunk of a bag", path)
        elif kind == ROS1_CHUNK_INFO:
            for connection, messages in struct.iter_unpack("<II", _exact(file, count)):
                chunks[connection] += messages
        records[kind] += kind != ROS1_CONNECTION or offset > begin  # connections stand in chunks, too
        offset = file.seek(offset + count)
    if offset != size:
        raise ValueError("it ends within a record")
    counted = records[ROS1_CONNECTION], records[ROS1_CHUNK]
    if counted != stated or records[ROS1_CHUNK] != records[ROS1_CHUNK_INFO]:
        raise ValueError(
            f"it has {counted[0]} connections and {counted[1]} chunks, but says {stated[0]} and {stated[1]}, and "
            f"describes {records[ROS1_CHUNK_INFO]} chunks"
        )
    return {"index": index, "index of chunks": chunks}


def _fields(header: bytes) -> dict[bytes, bytes]:
    fields, offset = {}, 0
    while offset < len(header):
        (count,) = struct.unpack_from("<I", header, offset)
        name, _, value = header[offset + 4 : offset + 4 + count].partition(b"=")
        fields[name] = value
        offset += 4 + count
    return fields


def _number(header: Mapping[bytes, bytes], name: bytes) -> int:
    return struct.unpack("<I", header[name])[0]


def _exact(file: BinaryIO, count: int) -> bytes:
    data = file.read(count)
    if len(data) < count:
        raise ValueError("it ends within a record")
    return data


def _of_database(path: Path) -> dict[str, Counts]:
    log = path.with_name(f"{path.name}-wal")
    if log.is_file() and log.stat().st_size:
        way = f"let SQLite write them back: sqlite3 {path.name} 'PRAGMA wal_checkpoint'"
        raise Refused(f"a bag must be closed, but rows of {path} are still in {log.name}; {way}")
    with closing(sqlite3.connect(f"file:{quote(str(path))}?immutable=1", uri=True)) as database:
        (fault,) = next(database.execute("PRAGMA integrity_check(1)"))
        if fault != "ok":
            raise ValueError(f"its database is damaged: {fault}")
        if database.execute("SELECT 1 FROM sqlite_master WHERE name = 'message_definitions'").fetchone():
            _check_defined_once(database, path)
        counts = database.execute("SELECT topic_id, COUNT(*) FROM messages NOT INDEXED GROUP BY topic_id")
        return {"table of messages": dict(counts)}


def _check_defined_once(database: sqlite3.Connection, path: Path) -> None:
    """Raise Refused for a type with two definitions, because the reader takes the first."""
    twice = database.execute(
        "SELECT topic_type FROM message_definitions GROUP BY topic_type "
        "HAVING COUNT(DISTINCT encoded_message_definition) > 1"
    ).fetchone()
    if twice:
        raise Refused(f"a file of a bag must define a type once, but {path} defines {twice[0]} twice")


def _check_whole(path: Path) -> None:
    """Raise ValueError for a database of SQLite that has fewer pages than it says; SQLite reads what is left."""
    with path.open("rb") as file:
        head = file.read(100)
    if head[24:28] == head[92:96]:  # the count of pages is that of the last change
        page = int.from_bytes(head[16:18]) or 1
        count = int.from_bytes(head[28:32])
        if path.stat().st_size < count * (page if page > 1 else 65536):
            raise ValueError(f"{path.name} is cut off")


class Bag(NamedTuple):
    """The files of a bag and their metadata."""

    files: tuple[Path, ...]
    is_packed: bool = False  # whether each message is
    begin: int | None = None  # when the first message was received [ns]; None where only the files say so
    counts: Mapping[str, int] = {}  # messages by topic


@contextmanager
def files_of(path: Path, kind: str) -> Iterator[Bag]:
    """The files of a bag, in order; packed ones are unpacked into a temporary folder, to MOST_BYTES in all.

    Args:
        path: of a file, or of a folder with metadata.yaml.
        kind: of the bag, for messages.

    Raises:
        ValueError: if the metadata is damaged, or files are missing or unpack to too much.
    """
    if not path.is_dir():
        yield Bag((path,))
        return
    content = _metadata(path, kind)
    mode = str(content.get("compression_mode") or "").lower()
    if content["version"] > NEWEST or mode not in PACKED:
        raise ValueError(f"its {METADATA} has version {content['version']} and compression {mode!r}")
    if mode in ("file", "message") and content["compression_format"] != "zstd":
        raise ValueError(f"it is packed by {content['compression_format']!r}")
    counts: dict[str, int] = {}
    for topic in content["topics_with_message_count"]:
        name = topic["topic_metadata"]["name"]
        counts[name] = counts.get(name, 0) + topic["message_count"]
    begin = content["starting_time"]["nanoseconds_since_epoch"] if content["message_count"] else None
    files = tuple(path / PurePath(name).name for name in content["relative_file_paths"])
    missing = [file.name for file in files if not file.is_file()]
    if missing:
        raise ValueError(f"{', '.join(missing)} is not there")
    with TemporaryDirectory() as folder:
        if mode == "file":
            files = _unpacked(files, Path(folder), path, kind)
        yield Bag(files, mode == "message", begin, counts)


def _metadata(path: Path, kind: str) -> dict[str, Any]:
    yaml = package("ruamel.yaml", kind, path)
    file = path / METADATA
    check_bytes(file.stat().st_size, "the metadata of a bag", path)
    try:
        content = yaml.YAML(typ="safe").load(file.read_text(encoding="utf-8"))["rosbag2_bagfile_information"]
        for key in ("version", "topics_with_message_count", "starting_time", "message_count"):
            content[key]
    except Exception as error:  # of the text, or of what is in it
        raise ValueError(f"its {METADATA} is damaged: {error}") from None
    return content


def unpacker(kind: str, path: Path) -> Any:
    """The module that unpacks Zstandard."""
    return package("compression.zstd" if sys.version_info >= (3, 14) else "backports.zstd", kind, path)


def _unpacked(files: tuple[Path, ...], folder: Path, path: Path, kind: str) -> tuple[Path, ...]:
    zstd, total, unpacked = unpacker(kind, path), 0, []
    for file in files:
        unpacked.append(folder / file.stem)
        with file.open("rb") as packed:
            stated = zstd.get_frame_info(packed.read(18)).decompressed_size  # of bytes that may hold its header
        check_bytes(total + (stated or 0), "what the files of a bag unpack to", path)
        with zstd.open(file, "rb") as packed, unpacked[-1].open("wb") as target:
            while piece := packed.read(min(PIECE, topics.MOST_BYTES)):
                total += len(piece)
                check_bytes(total, "what the files of a bag unpack to", path)
                target.write(piece)
    return tuple(unpacked)
