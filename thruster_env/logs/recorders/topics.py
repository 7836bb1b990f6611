"""The topics that readers of recorders' files return, whose fields share their times; and limits of sizes."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Collection, Container, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout, suppress
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from thruster_env.core.modules import to_install

MOST_BYTES = 2**31  # of all arrays that are read at once, and of a file that a package reads whole
MOST_MEMORY = 3 * MOST_BYTES  # by which a process may grow while a package unpacks a file
MOST_COLUMNS = 64  # of a field that is an array: pictures and point clouds are no channels
MOST_FIELDS = 20_000  # of a message

Wanted = Collection[str] | None  # names of columns; None for all
HEADER_TYPE = "std_msgs/msg/Header"
STAMPED = "geometry_msgs/msg/TransformStamped"


class Topic(NamedTuple):
    """Fields with samples at the same times."""

    name: str  # "actuator_outputs", "actuator_outputs#1"; empty for an array that stands alone
    times: np.ndarray | None  # (samples,) [s]; None where the file has none for it
    values: Mapping[str, np.ndarray]  # (samples,) float64 by field: "output[0]"
    units: Mapping[str, str] = {}  # by field, where the file has them
    unread: Mapping[str, str] = {}  # why fields are not read; "" for all of the topic
    damage: str = ""  # what of the file is not read because it is damaged, in words
    clock: str = ""  # "header" or "receipt" in a bag
    received: np.ndarray | None = None  # (samples,) [s]; None where the times are these, or a file has no such
    assumption: str = ""  # how times without a unit were read, in words

    def column(self, field: str) -> str:
        """The name of a field's column: TOPIC.FIELD."""
        return f"{self.name}.{field}" if self.name else field


def joined(parts: Sequence[Topic], order: Sequence[np.ndarray] | None = None) -> Topic:
    """Join parts of a topic with several definitions by the names of fields; NaN in rows without a field.

    Args:
        parts: of the same name, all with times.
        order: of each part, what its rows are sorted by (samples,); None for the times.
    """
    if len(parts) == 1:
        return parts[0]
    times = np.concatenate([np.empty(0) if part.times is None else part.times for part in parts])
    rows = np.argsort(times if order is None else np.concatenate(order), kind="stable")
    values: dict[str, np.ndarray] = {}
    units: dict[str, str] = {}
    unread, row = dict(parts[0].unread), 0
    for part in parts:
        end = row + len(np.empty(0) if part.times is None else part.times)
        unread |= part.unread
        for field, numbers in part.values.items():
            values.setdefault(field, np.full(len(times), np.nan))[row:end] = numbers
            unit = part.units.get(field, "")
            if units.setdefault(field, unit) != unit:
                unread[field] = f"in {units[field] or 'no unit'} and in {unit or 'no unit'}"
        row = end
    return Topic(
        parts[0].name,
        times[rows],
        {field: numbers[rows] for field, numbers in values.items() if field not in unread},
        {field: unit for field, unit in units.items() if unit},
        unread,
        " ".join(dict.fromkeys(part.damage for part in parts if part.damage)),
    )


Reader = Callable[[Path, Wanted], Iterator[Topic]]


class Format(NamedTuple):
    """A format of recorders' files."""

    kind: str  # its name in messages
    endings: tuple[str, ...]
    magic: bytes  # the first bytes of a file
    topics: Reader
    has_stamps: bool = True  # whether each topic has times of its own, whatever its fields are called
    has_units: bool = True  # whether units are in the file, and not only known of its messages
    has_receipt: bool = False  # whether messages have times of reception beside those of headers


def wants(wanted: Wanted, topic: str) -> bool:
    """Whether a column of a topic is wanted."""
    return wanted is None or any(column.startswith(f"{topic}.") for column in wanted)


def package(module: str, kind: str, path: Path) -> Any:
    """A module of the extra `recorders`; ValueError says how to install it."""
    try:
        return import_module(module)
    except ImportError:
        name = module.partition(".")[0]
        rule = f"a {kind} must be read by {name}, which is not installed ({to_install('recorders')})"
        raise ValueError(f"{rule}, but got {path}") from None


class Refused(ValueError):
    """A file has the format of its name, but contents that are not read."""


def check_bytes(count: int | float, what: str, path: Path) -> None:
    """Raise Refused for more than MOST_BYTES, before they are read."""
    if count > MOST_BYTES:
        raise Refused(f"{what} must be at most {MOST_BYTES:.3g} bytes, but got {count:.3g} ({path})")


def unreadable(kind: str, path: Path, why: object) -> ValueError:
    """The error for a file that does not have the format of its name."""
    text = " ".join(str(why).split())
    return ValueError(f"a {kind} must be one, but {path} is not: {text[:200] or type(why).__name__}")


@contextmanager
def reading(kind: str, path: Path) -> Iterator[None]:
    """Turn any error that a package raises for damaged bytes into one line."""
    try:
        yield
    except Refused:
        raise
    except Exception as error:
        raise unreadable(kind, path, error) from None


@contextmanager
def bounded(what: str, path: Path) -> Iterator[None]:
    """Let the process grow by MOST_MEMORY at most, so that what unpacks to more is refused, in one line.

    The limit is the operating system's, on Linux; elsewhere there is none. Nothing may be yielded within.
    """
    most = MOST_MEMORY
    try:
        import resource

        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    except (ImportError, OSError):
        yield
        return
    before = soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    limit = pages * resource.getpagesize() + most
    if soft == resource.RLIM_INFINITY or limit < soft:
        resource.setrlimit(resource.RLIMIT_AS, (limit, hard))
    try:
        yield
    except MemoryError:
        raise Refused(f"{what} must take at most {most:.3g} bytes of memory, but {path} takes more") from None
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


@contextmanager
def silent() -> Iterator[None]:
    """Keep packages from printing, also those in C; nothing may be yielded within."""
    with open(os.devnull, "w", encoding="utf-8") as nowhere, redirect_stdout(nowhere), redirect_stderr(nowhere):
        stderr_copy = os.dup(2)
        try:
            os.dup2(nowhere.fileno(), 2)
            yield
        finally:
            os.dup2(stderr_copy, 2)
            os.close(stderr_copy)


def columns_of(name: str, values: np.ndarray) -> dict[str, np.ndarray]:
    """The fields of an array (samples,) or (samples, entries): NAME, or NAME[0], NAME[1] and so on."""
    if values.ndim == 1:
        return {name: values.astype(np.float64)}
    return {f"{name}[{index}]": values[:, index].astype(np.float64) for index in range(values.shape[1])}


class Pairs:
    """Names of the topics of pairs of frames: TOPIC/PARENT/CHILD, without slashes at the beginning of a frame."""

    def __init__(self, path: Path):
        self._path = path
        self._pairs: dict[str, tuple[str, str, str]] = {}

    def topics(self, topic: str, transforms: Any) -> Iterator[tuple[str, Any]]:
        """Each transform of a message of a topic, with the name of its pair's topic.

        Raises:
            ValueError: if two pairs have one name, or there are more than MOST_FIELDS.
        """
        for transform in transforms:
            parent, child = transform.header.frame_id.lstrip("/"), transform.child_frame_id.lstrip("/")
            name = f"{topic}/{parent}/{child}"
            if self._pairs.setdefault(name, (topic, parent, child)) != (topic, parent, child):
                raise self._doubled(name)
            if len(self._pairs) > MOST_FIELDS:
                rule = f"a bag must have at most {MOST_FIELDS} pairs of frames"
                raise Refused(f"{rule}, but got more ({self._path})")
            yield name, transform

    def check(self, topics: Container[str]) -> None:
        """Raise ValueError if a pair has the name of one of the topics of the bag."""
        for name in self._pairs:
            if name in topics:
                raise self._doubled(name)

    def _doubled(self, name: str) -> Refused:
        rule = "pairs of frames must have names of their own, TOPIC/PARENT/CHILD"
        return Refused(f"{rule}, but two topics of {self._path} are {name[:200]!r}")


SCRIPT = Path(__file__).with_name("process_script.py")
KINDS = "biufmM"  # NumPy's, of what comes as bytes


class Opened:
    """A file that another process has opened.

    Attributes:
        contents: of the file, as the other process describes them.
    """

    def __init__(self, child: subprocess.Popen, form: str, path: Path):
        self._child, self._path = child, path
        files = sorted(path.rglob("*.parquet")) if path.is_dir() else [path]
        request = {"format": form, "path": str(path.absolute()), "files": [str(file.absolute()) for file in files]}
        limits = {"memory": MOST_MEMORY, "bytes": MOST_BYTES}
        self.contents = self._ask(json.dumps({**request, **limits}))

    def read(self, number: int) -> np.ndarray:
        """An array of the file: numbers and dates as they are stored, others as texts."""
        answer = self._ask(str(number))
        shape = tuple(int(side) for side in answer["shape"])
        if "texts" in answer:
            return np.array(answer["texts"], object).reshape(shape)
        kind = np.dtype(str(answer["dtype"]))
        if kind.kind not in KINDS:
            raise ValueError(f"numbers of {kind}")
        values = np.empty(shape, kind)
        left = values.reshape(-1).view(np.uint8).data
        while len(left):
            count = self._child.stdout.readinto(left)  # type: ignore[union-attr]
            if not count:
                raise ValueError(self._end())
            left = left[count:]
        return values

    def _ask(self, line: str) -> dict[str, Any]:
        try:
            self._child.stdin.write(line.encode() + b"\n")  # type: ignore[union-attr]
            self._child.stdin.flush()  # type: ignore[union-attr]
        except OSError:
            raise ValueError(self._end()) from None
        answer = self._child.stdout.readline()  # type: ignore[union-attr]
        if not answer.endswith(b"\n"):
            raise ValueError(self._end())
        content = json.loads(answer)
        if content.get("is_memory"):
            most = f"{MOST_MEMORY:.3g} bytes of memory"
            raise Refused(f"a file must take at most {most}, but {self._path} takes more")
        if "error" in content:
            raise ValueError(content["error"])
        return content

    def _end(self) -> str:
        """Why the other process has ended, in words."""
        code = self._child.wait()
        why = signal.Signals(-code).name if code < 0 else f"exit code {code}"
        return f"the library that reads it breaks off ({why})"


@contextmanager
def opened(form: str, path: Path) -> Iterator[Opened]:
    """A file that a process has opened, which ends with the context.

    Args:
        form: "hdf5" or "parquet".
        path: of the file.

    Raises:
        ValueError: if the library cannot read it, or breaks off.
    """
    command = [sys.executable, "-P", str(SCRIPT)]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    ) as child:
        try:
            yield Opened(child, form, path)
        finally:
            child.kill()
            with suppress(OSError):  # of a request that was never read
                child.stdin.close()  # type: ignore[union-attr]
