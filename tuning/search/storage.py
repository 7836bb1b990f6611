"""Where studies live: a journal file by default, made safe to resume; a database for several machines."""

from __future__ import annotations

import os
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import optuna
from optuna.exceptions import UpdateFinishedTrialError
from optuna.storages import BaseStorage
from optuna.storages.journal import JournalFileOpenLock
from optuna.trial import FrozenTrial, TrialState

from thruster_env.core.checks import short_repr
from tuning.search.journal import Journal, JournalFile, cut_unfinished_line
from tuning.search.storage_url import first_line, is_misspelt, public_url, without_secrets

DRIVER = "pip install '.[db]' in the project's folder, and postgresql+psycopg2:// in the URL"
LOCK_SECONDS = 5  # after which a lock counts as left behind
SIGNATURE_SECONDS = 2 * LOCK_SECONDS  # by which a living process has signed its trial
PROCESS, RETRY_OF = (
    "process",
    "retry_of",
)  # trial attributes: who runs it, and which one it repeats


def open_storage(storage: Any) -> BaseStorage:
    """Open a storage: a URL such as "postgresql+psycopg2://..." or "grpc://host:port", else a journal file.

    A database may be unreachable for a minute; a trial without a heartbeat is lost, and enqueued again.

    A last line that a killed process left unfinished in a journal is cut off, with a warning.

    Raises:
        ValueError: if it cannot be reached, is no journal, or is neither text nor a path.
    """
    storage = storage_text(storage)
    if "://" in storage:
        from tuning.search.database import open_database

        try:
            return open_database(storage, retry_once)
        except Exception as error:  # SQLAlchemy, its drivers and the network raise whatever they like
            reason = without_secrets(first_line(error), storage)
            if isinstance(error, ImportError) and storage.startswith("postgresql"):
                reason = f"{reason.rstrip('.')}: {DRIVER}"
            raise ValueError(
                f"storage must be a database that can be reached, but got {public_url(storage)}: {reason}"
            ) from None
    path = Path(storage).resolve()  # one lock, whichever link leads to a journal
    try:
        if is_misspelt(storage):  # which would become folders, its password their name
            raise ValueError("a URL has :// after its first word")
        if path.exists() and not path.is_file():
            raise ValueError("it is not a regular file")
        path.parent.mkdir(parents=True, exist_ok=True)
        # A killed process may leave its lock behind; locks are held for milliseconds.
        lock = JournalFileOpenLock(str(path), grace_period=LOCK_SECONDS)
        lock.acquire()
        try:
            if path.exists():
                cut_unfinished_line(path)
        finally:
            lock.release()
        return Journal(JournalFile(path, lock))
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise ValueError(
            f"storage must be a journal file that can be written, but got {public_url(storage)}: {error}"
        ) from None


def storage_text(storage: Any) -> str:
    """A storage as text; ValueError for what is neither text nor a path: a number would name a file."""
    text = os.fspath(storage) if isinstance(storage, str | os.PathLike) else None
    if not isinstance(text, str) or not text:
        rule = "storage must be a journal file, such as 'studies.journal', or the URL of a database"
        raise ValueError(f"{rule}, but got {short_repr(storage)}")
    return text


def this_process() -> str:
    """Name of this process for trials that it runs: host and process number."""
    return f"{os.uname().nodename}:{os.getpid()}"


def retry_orphans(study: optuna.Study) -> int:
    """Fail running trials whose process on this host is gone, and enqueue each again; return how many."""
    retried = 0
    for trial in study.get_trials(deepcopy=False, states=(TrialState.RUNNING,)):
        signed = _wait_for_signature(study, trial)
        if signed.state != TrialState.RUNNING or _may_live(signed.user_attrs.get(PROCESS)):
            continue
        try:
            study.tell(signed.number, state=TrialState.FAIL)
        except (ValueError, UpdateFinishedTrialError):  # another process was faster
            continue
        retried += retry_once(study, signed)
    return retried


def retry_once(study: optuna.Study, trial: FrozenTrial) -> bool:
    """Enqueue a lost trial again, unless it is a second try or has no parameters yet; return whether it was."""
    parameters = {**trial.system_attrs.get("fixed_params", {}), **trial.params}  # first those it was enqueued with
    if RETRY_OF in trial.user_attrs or not parameters:
        return False
    study.enqueue_trial(parameters, user_attrs={RETRY_OF: trial.number})
    return True


def drop_waiting(study: optuna.Study) -> None:
    """Fail trials that are enqueued, each unless another process begins it first."""
    for trial in study.get_trials(deepcopy=False, states=(TrialState.WAITING,)):
        with suppress(UpdateFinishedTrialError):
            if study._storage.set_trial_state_values(trial._trial_id, state=TrialState.RUNNING):
                study.tell(trial.number, state=TrialState.FAIL)


def _wait_for_signature(study: optuna.Study, trial: FrozenTrial) -> FrozenTrial:
    """The trial as it is when its process has signed it, right after asking for it, or has had time to."""
    deadline = time.monotonic() + SIGNATURE_SECONDS
    while trial.state == TrialState.RUNNING and PROCESS not in trial.user_attrs and time.monotonic() < deadline:
        time.sleep(0.1)
        trial = study.get_trials(deepcopy=False)[trial.number]
    return trial


def _may_live(process: str | None) -> bool:
    """Whether a process, as `this_process` names it, is alive or on another host."""
    if process is None:
        return False
    host, _, number = process.rpartition(":")
    return host != os.uname().nodename or is_alive(int(number))


def is_alive(process: int) -> bool:
    """Whether there is a process of this number on this host."""
    if process <= 0:
        return False
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True
