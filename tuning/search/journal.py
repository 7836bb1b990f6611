"""A study's journal file, whose lines stay complete after a full disk, a killed process or an interrupt."""

from __future__ import annotations

import json
import os
import warnings
from pathlib import Path

from optuna.storages.journal import JournalFileBackend, JournalFileOpenLock


class JournalFile(JournalFileBackend):
    """Optuna's journal file, to which a line is added as a whole or not at all."""

    def __init__(self, path: Path, lock: JournalFileOpenLock):
        """Take its path, and the lock of its writers."""
        super().__init__(str(path), lock_obj=lock)
        self._path, self._writers = path, lock

    def append_logs(self, logs: list[dict]) -> None:
        """Add a line for each entry.

        Raises:
            OSError: if there is no room; the file is then as it was, and others can go on with it.
        """
        lines = "".join(json.dumps(log, separators=(",", ":")) + "\n" for log in logs)
        self._writers.acquire()
        try:
            size = self._path.stat().st_size
            try:
                with self._path.open("ab") as stream:
                    stream.write(lines.encode())
                    stream.flush()
                    os.fsync(stream.fileno())
            except BaseException:
                os.truncate(self._path, size)
                raise
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(self._path)) from None
        finally:
            self._writers.release()


def cut_unfinished_line(path: Path) -> None:
    """Cut off a last line that a killed process left unfinished, with a warning.

    Raises:
        ValueError: if it is no journal, or damaged elsewhere.
    """
    content = path.read_bytes()
    lines = content.splitlines(keepends=True)
    for number, line in enumerate(lines, start=1):
        try:
            whole = line.endswith(b"\n") and isinstance(json.loads(line), dict)
        except ValueError:
            whole = False
        if whole:
            continue
        if number < len(lines):
            raise ValueError(f"line {number} is no journal entry")
        if number == 1:
            raise ValueError("it is no journal")
        warnings.warn(f"{path}: cut off its last line, which a process left unfinished", stacklevel=4)
        with path.open("r+b") as stream:
            stream.truncate(len(content) - len(line))
