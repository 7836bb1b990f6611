"""Files written completely or not at all, TOML files, and the common form of pictures.

A temporary file is renamed into place; links are followed. Each picture is one PNG, SVG or PDF file.
"""

from __future__ import annotations

import contextlib
import io
import os
import secrets
import stat
import tempfile
import tomllib
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

from thruster_env.core.modules import AtFirstUse

if TYPE_CHECKING:
    import numpy as np

if not TYPE_CHECKING:
    np = AtFirstUse("numpy")

STREAMS = (1, 2)  # descriptors of standard output and standard error

# Of pictures.
DARK, BLUE, RUST = "#222222", "#0b6fa4", "#b5541c"
SKY, MUSTARD, GREEN, PLUM, WINE = "#56b4e9", "#c99700", "#009e73", "#b065a0", "#882255"
GREY, PALE, TRUE = "#9aa5ad", "#c5ccd1", "#7d848a"
MOST_POINTS = 600  # of a line, some four in a millimetre


def check_target(path: str | Path) -> None:
    """Raise ValueError if a file could not be written there, before long work is done for it."""
    path = Path(path)
    try:
        status = _status(path)
        if status is not None and not _is_replaced(status):
            return
        target = _target(path)
        target.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=target.parent):
            pass
    except OSError as error:
        raise _refusal(path, error) from None


def is_private(folder: Path) -> bool:
    """Whether a folder, no link to one, is this user's, and nobody else can read or write it.

    Raises OSError if there is none.
    """
    status = folder.lstat()
    is_own = not hasattr(os, "getuid") or (status.st_uid == os.getuid() and not status.st_mode & 0o077)
    return stat.S_ISDIR(status.st_mode) and is_own


def write_whole(path: str | Path, content: str | bytes | Callable[[BinaryIO], None]) -> None:
    """Write a file aside, then rename it into place: a reader sees the old file or the new one.

    An existing file keeps its mode; a new one gets its mode from the umask. A link stays, and its target is
    written. A device, a pipe or this process's own standard output is appended to in place.

    Args:
        path: where; missing folders are made.
        content: text, bytes, or a function that writes to a binary stream.

    Raises:
        ValueError: if it cannot be written there.
    """
    if callable(content):  # into memory first: pipes cannot be sought, and an error leaves nothing half-written
        stream = io.BytesIO()
        content(stream)
        content = stream.getvalue()
    content = content.encode() if isinstance(content, str) else content
    path = Path(path)
    try:
        status = _status(path)
        if status is None or _is_replaced(status):
            _replace(_target(path), content, status)
        else:
            with open(path, "ab") as existing:
                existing.write(content)
    except OSError as error:
        raise _refusal(path, error) from None


def _status(path: Path) -> os.stat_result | None:
    """The status of an existing file, links followed; OSError if it cannot be written."""
    try:
        status = os.stat(path)
    except FileNotFoundError:
        return None
    if stat.S_ISDIR(status.st_mode):
        raise IsADirectoryError(None, "it is a folder")
    if not os.access(path, os.W_OK):  # a rename would replace it even so
        raise PermissionError(None, "it is read-only")
    return status


def _is_replaced(status: os.stat_result) -> bool:
    """Whether a file is regular and not this process's own output, so that it may be replaced."""
    return stat.S_ISREG(status.st_mode) and not any(_is_open_as(stream, status) for stream in STREAMS)


def _is_open_as(descriptor: int, status: os.stat_result) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), status)
    except OSError:  # closed
        return False


def _target(path: Path) -> Path:
    return Path(os.path.realpath(path))


def _replace(target: Path, content: bytes, before: os.stat_result | None) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    aside = target.with_name(f".{target.name[:40]}.{secrets.token_hex(8)}")
    # Unlike `tempfile`, this leaves the mode of a new file to the umask.
    descriptor = os.open(aside, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)
    try:
        with os.fdopen(descriptor, "wb") as stream:
            stream.write(content)
        if before is not None and hasattr(os, "chown"):
            with contextlib.suppress(OSError):  # for root, or a group of one's own
                os.chown(aside, before.st_uid, before.st_gid)
            os.chmod(aside, before.st_mode & 0o777)
        os.replace(aside, target)
    except BaseException:
        aside.unlink(missing_ok=True)
        raise


def _refusal(path: Path, error: OSError) -> ValueError:
    return ValueError(f"a file must be where it can be written, but {path} is not: {error.strerror}")


def read_toml(path: str | Path, what: str) -> dict:
    """The content of a TOML file; ValueError, with the path and what it is ("a preset file"), if there is none."""
    try:
        return tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise ValueError(f"{what} must be readable, but {path} is not: {error.strerror}") from None
    except (ValueError, RecursionError) as error:  # not TOML, nested too deeply, or not even text
        raise ValueError(f"{what} must be TOML, but {path} is not: {error}") from None


def as_toml(tables: Mapping[str, Mapping], about: str = "") -> str:
    """A file of tables, empty ones left out, with a line of comment at its beginning.

    Args:
        tables: texts, numbers, truth values, lists and mappings of these, by key, by table.
        about: the comment.
    """
    lines = [f"# {about}"] if about else []
    for name, table in tables.items():
        if table:
            lines += [""] if lines else []
            lines += [f"[{name}]", *(f"{_key(key)} = {_text(value)}" for key, value in table.items())]
    return "\n".join(lines) + "\n"


def _key(name: str) -> str:
    return name if name.replace("_", "").replace("-", "").isalnum() and name.isascii() else _text(name)


def _text(value) -> str:
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{_key(name)} = {_text(part)}" for name, part in value.items()) + "}"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(map(_text, value)) + "]"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        characters = (f"\\u{ord(c):04X}" if ord(c) < 32 or c in '"\\\x7f' else c for c in value)
        return '"' + "".join(characters) + '"'
    return repr(float(value)) if isinstance(value, float) else repr(value)


def new_figure(size: tuple[float, float]):
    """An empty figure of a size [inch] that is laid out by itself and belongs to no window."""
    from matplotlib.figure import Figure

    return Figure(figsize=size, layout="constrained", dpi=120)


def tidy(axes: Iterable) -> None:
    """Give axes their common form: a faint grid, no frame above and to the right."""
    for axis in axes:
        axis.spines[["top", "right"]].set_visible(False)
        axis.grid(alpha=0.25, linewidth=0.6)


def grid_of(count: int, columns: int) -> tuple[int, int]:
    """Rows and columns for `count` panels, at most `columns` side by side, and none of the rows empty."""
    columns = max(1, min(columns, count))
    return -(-count // columns), columns


def panels(count: int, columns: int, size: tuple[float, float], extra: float = 0.0, **options):
    """A figure and exactly `count` axes in a grid, in their common form.

    Args:
        count: of panels.
        columns: largest number side by side.
        size: of a panel [inch].
        extra: height for a title or a legend [inch].
        **options: of matplotlib's `subplots`.
    """
    rows, columns = grid_of(count, columns)
    figure = new_figure((size[0] * columns, size[1] * rows + extra))
    axes = list(figure.subplots(rows, columns, squeeze=False, **options).flat)
    for axis in axes[count:]:
        axis.remove()
    tidy(axes[:count])
    return figure, axes[:count]


def legend_below(figure, axes: Iterable, most: int | None = None, **options) -> None:
    """One legend below a whole figure, of all that some of its axes name.

    Args:
        figure: of matplotlib.
        axes: whose labels it has, each once.
        most: entries side by side; all if None.
        **options: of matplotlib's `legend`.
    """
    named: dict = {}
    for axis in axes:
        handles, labels = axis.get_legend_handles_labels()
        named |= dict(zip(labels, handles, strict=True))
    columns = len(named) if most is None else min(most, len(named))
    figure.legend(named.values(), named, loc="outside lower center", ncols=columns, frameon=False, **options)


def thinned(x: np.ndarray, y: np.ndarray, keep: np.ufunc | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Points of a line, (N,) each: of long ones the smallest and the largest value of each stretch.

    Args:
        x: ascending.
        y: values, NaN where there are none.
        keep: `np.fmin` or `np.fmax` for the smallest or the largest alone, as an edge of a band needs it.
    """
    if len(x) <= MOST_POINTS:
        return x, y
    points = 3 if keep is None and np.isnan(y).any() else 2  # of a stretch: a gap is one more
    parts = np.array_split(np.arange(len(x)), MOST_POINTS // points)
    if keep is not None:
        return np.array([x[part].mean() for part in parts]), np.array([keep.reduce(y[part]) for part in parts])
    low, high = np.where(np.isfinite(y), y, np.inf), np.where(np.isfinite(y), y, -np.inf)
    ends = [part[index] for part in parts for index in (low[part].argmin(), high[part].argmax())]
    gaps = [part[np.isnan(y[part])][:1] for part in parts]
    indices = np.unique(np.concatenate([ends, *gaps])).astype(np.int64)
    return x[indices], y[indices]


def save_figure(figure, path: str | Path) -> Path:
    """Write a figure as SVG or PDF where the name ends so, else as PNG, whole or not at all; return the path."""
    form = {".svg": "svg", ".pdf": "pdf"}.get(Path(path).suffix, "png")
    write_whole(path, lambda stream: figure.savefig(stream, format=form))
    return Path(path)
