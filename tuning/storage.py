"""Where studies live: a journal file by default, made safe to resume; any Optuna URL otherwise."""

from __future__ import annotations

import json
import os
import warnings
from pathlib import Path

import optuna
from optuna.storages import BaseStorage, JournalStorage
from optuna.storages.journal import JournalFileBackend, JournalFileOpenLock
from optuna.trial import TrialState

LOCK_SECONDS = 5  # after which a lock counts as left behind
PROCESS, RETRY_OF = "process", "retry_of"  # trial attributes: who runs it, and what it repeats


def open_storage(storage: str) -> BaseStorage:
    """Open a storage: a URL such as "sqlite:///file.db" or "postgresql+psycopg2://...", else a journal file.

    A last line that a killed process left unfinished in a journal is cut off, with a warning.

    Raises:
        ValueError: if it cannot be reached or is no journal.
    """
    if "://" in storage:
        try:
            return optuna.storages.RDBStorage(storage)
        except Exception as error:  # SQLAlchemy, its drivers and the network raise whatever they like
            reason = str(error).strip().splitlines()[0]
            raise ValueError(
                f"storage must be a database that can be reached, but got {storage}: {reason}"
            ) from None
    path = Path(storage).absolute()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        # A killed process may leave its lock behind; locks are held for milliseconds.
        lock = JournalFileOpenLock(str(path), grace_period=LOCK_SECONDS)
        lock.acquire()
        try:
            if path.exists():
                _cut_unfinished_line(path)
        finally:
            lock.release()
        return JournalStorage(JournalFileBackend(str(path), lock_obj=lock))
    except (OSError, ValueError, KeyError) as error:
        raise ValueError(
            f"storage must be a journal file that can be written, but got {storage}: {error}"
        ) from None


def _cut_unfinished_line(path: Path) -> None:
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


def this_process() -> str:
    """Name of this process for trials that it runs: host and process number."""
    return f"{os.uname().nodename}:{os.getpid()}"


def retry_orphans(study: optuna.Study) -> int:
    """Fail running trials whose process on this host is gone, and queue each once more; return how many."""
    host = os.uname().nodename
    retried = 0
    for trial in study.get_trials(deepcopy=False, states=(TrialState.RUNNING,)):
        owner, _, number = str(trial.user_attrs.get(PROCESS, f"{host}:0")).rpartition(":")
        if owner != host or _alive(int(number)):
            continue
        study.tell(trial.number, state=TrialState.FAIL)
        if RETRY_OF not in trial.user_attrs and trial.params:
            study.enqueue_trial(trial.params, user_attrs={RETRY_OF: trial.number})
            retried += 1
    return retried


def _alive(process: int) -> bool:
    if process <= 0:
        return False
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True
