"""The files of a bag: one, or those that the metadata.yaml of a folder names, unpacked where they are packed."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path, PurePath
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

from thruster_env.logs.recorders import topics
from thruster_env.logs.recorders.topics import check_bytes, package

METADATA = "metadata.yaml"
NEWEST = 9  # version of the metadata
PACKED = ("", "none", "file", "message")
PIECE = 2**20  # bytes


class Bag(NamedTuple):
    """The files of a bag, and what its metadata says of them."""

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
    for one in content["topics_with_message_count"]:
        name = one["topic_metadata"]["name"]
        counts[name] = counts.get(name, 0) + one["message_count"]
    begin = content["starting_time"]["nanoseconds_since_epoch"] if content["message_count"] else None
    files = tuple(path / PurePath(one).name for one in content["relative_file_paths"])
    missing = [one.name for one in files if not one.is_file()]
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
    """Files unpacked into a folder, as far as they are at most MOST_BYTES in all."""
    zstd, total, found = unpacker(kind, path), 0, []
    for file in files:
        found.append(folder / file.stem)
        with file.open("rb") as packed:
            stated = zstd.get_frame_info(packed.read(18)).decompressed_size  # of bytes that may hold its header
        check_bytes(total + (stated or 0), "what the files of a bag unpack to", path)
        with zstd.open(file, "rb") as packed, found[-1].open("wb") as target:
            while piece := packed.read(min(PIECE, topics.MOST_BYTES)):
                total += len(piece)
                check_bytes(total, "what the files of a bag unpack to", path)
                target.write(piece)
    return tuple(found)
