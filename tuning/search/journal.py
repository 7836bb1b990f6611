"""A study's journal file, whose lines stay complete after a full disk, a killed process or an interrupt."""

from __future__ import annotations

import json
import os
import warnings
from collections.abc import Generator
from contextlib import suppress
from pathlib import Path
from typing import Any

from optuna.exceptions import UpdateFinishedTrialError
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend, JournalFileOpenLock

INTERMEDIATE = "intermediate_value"  # key of an entry of Optuna's with the value of a seed
BEGINNING = b'{"op_code":'  # of each entry of a journal


class Journal(JournalStorage):
    """Optuna's journal storage, which reports a trial ended by another process as an error once."""

    def _sync_with_backend(self) -> None:
        """Read what is new; each value that waited would raise the error anew, in calls that others make."""
        try:
            super()._sync_with_backend()
        except UpdateFinishedTrialError:
            with suppress(UpdateFinishedTrialError):
                self._sync_with_backend()
            raise


class JournalFile(JournalFileBackend):
    """Optuna's journal file, to which entries are added as a whole or not at all.

    A disk takes a millisecond to store data permanently, more than a trial of a cheap filter. The file is
    therefore synchronised only for what must survive a power cut: a finished trial, with everything before it, and
    the attributes of a study. The values of single seeds of a running trial, which would be repeated anyway, are
    not urgent: they wait for the next entry of another kind, or the next reader in this process.
    """

    def __init__(self, path: Path, lock: JournalFileOpenLock):
        """Take its path, and the lock of its writers."""
        super().__init__(str(path), lock_obj=lock)
        self._path, self._writers = path, lock
        self._waiting: list[dict] = []
        self._was_put_off = False

    def __getstate__(self) -> dict:
        """All but what waits, which this one will write: of a copy it would be there twice, or after the end."""
        return {**vars(self), "_waiting": [], "_was_put_off": False}

    def append_logs(self, logs: list[dict]) -> None:
        """Add a line for each entry.

        Raises:
            OSError: if the disk is full; the file is then unchanged, and others can still use it.
        """
        self._was_put_off = all(INTERMEDIATE in log for log in logs)
        if self._was_put_off:
            self._waiting += logs
        else:
            self._write(logs)

    def read_logs(self, log_number_from: int) -> Generator[dict[str, Any], None, None]:
        """Entries from a number on; none right after one that waits, when Optuna reads what it has just added."""
        if self._was_put_off:
            self._was_put_off = False
            return
        if self._waiting:
            self._write([])
        yield from super().read_logs(log_number_from)

    def _write(self, logs: list[dict]) -> None:
        """Add what waits and some entries; what waits is of a trial that fails if there is no room for it."""
        logs, self._waiting = self._waiting + logs, []
        lines = "".join(json.dumps(log, separators=(",", ":")) + "\n" for log in logs)
        self._writers.acquire()
        try:
            size = self._path.stat().st_size
            try:
                with self._path.open("ab") as stream:
                    stream.write(lines.encode())
                    stream.flush()
                    if not all(map(_is_of_running_trial, logs)):
                        os.fsync(stream.fileno())
            except BaseException:
                os.truncate(self._path, size)
                raise
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(self._path)) from None
        finally:
            self._writers.release()


def _is_of_running_trial(log: dict) -> bool:
    """Whether an entry is of a trial that is not finished: which one it is, or when it began, but not its end."""
    return ("trial_id" in log or "datetime_start" in log) and "datetime_complete" not in log


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
        if number == 1 and (line.endswith(b"\n") or line[: len(BEGINNING)] != BEGINNING[: len(line)]):
            raise ValueError("it is no journal")
        warnings.warn(f"{path}: cut off its last line, which a process left unfinished", stacklevel=4)
        with path.open("r+b") as stream:
            stream.truncate(len(content) - len(line))
