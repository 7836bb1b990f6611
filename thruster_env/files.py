"""Files that are whole or not there: write aside, then rename."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO


def check_target(path: str | Path) -> None:
    """Raise ValueError if a file could not be written there, before long work is done for it."""
    path = Path(path)
    if path.is_dir():
        raise ValueError(f"a file must be where it can be written, but {path} is a folder")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise ValueError(f"a file must be where it can be written, but {path} is not: {error.strerror}") from None


def write_whole(path: str | Path, content: str | bytes | Callable[[BinaryIO], None]) -> None:
    """Write a file aside, then rename it into place: a reader sees the old file or the new one.

    Args:
        path: where; missing folders are made.
        content: text, bytes, or a function that writes to a binary stream.

    Raises:
        ValueError: if the folder cannot be written.
    """
    path = Path(path)
    aside = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        descriptor, aside = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        with os.fdopen(descriptor, "wb") as stream:
            if callable(content):
                content(stream)
            else:
                stream.write(content.encode() if isinstance(content, str) else content)
        os.chmod(aside, 0o644)
        os.replace(aside, path)
        aside = None
    except OSError as error:
        raise ValueError(f"a file must be where it can be written, but {path} is not: {error.strerror}") from None
    finally:
        if aside is not None:
            Path(aside).unlink(missing_ok=True)
