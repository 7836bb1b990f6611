"""Where studies live: a journal file by default, made safe to resume; a database for several machines."""

from __future__ import annotations

import contextlib
import os
import re
import time
import warnings
from collections.abc import Callable
from functools import wraps
from itertools import count
from pathlib import Path
from urllib.parse import urlsplit

import optuna
from optuna.exceptions import StorageInternalError, UpdateFinishedTrialError
from optuna.storages import BaseStorage, GrpcStorageProxy, JournalStorage, RDBStorage
from optuna.storages._cached_storage import _CachedStorage
from optuna.storages._heartbeat import BaseHeartbeat
from optuna.storages.journal import JournalFileOpenLock
from optuna.trial import FrozenTrial, TrialState
from sqlalchemy.exc import DBAPIError, OperationalError

from tuning.search.journal import JournalFile, cut_unfinished_line
from tuning.search.storage_url import is_misspelt, shown_storage, without_secrets

LOCK_SECONDS = 5  # after which a lock counts as left behind
SIGNATURE_SECONDS = 2 * LOCK_SECONDS  # by which a living process has signed its trial
TABLE_TRIES = 5  # to make the tables of a database, or to find them made
PATIENCE_SECONDS = 60  # for which a database may be away
CONNECT_SECONDS = 10  # timeout of a connection, for drivers that have one
WITH_TIMEOUT = re.compile(r"(postgresql(\+psycopg2?)?|(mysql|mariadb)(\+(pymysql|mysqldb))?)://")
HEARTBEAT_SECONDS = 10  # between two signs of life of a running trial in a database
GRACE_SECONDS = 180  # without one, after which it counts as lost; an outage is shorter
PROXY_PORT, PROXY_SECONDS = 13000, 10  # the default port of a proxy, and the time in which it has to answer
PROCESS, RETRY_OF = (
    "process",
    "retry_of",
)  # trial attributes: who runs it, and which one it repeats


def open_storage(storage: str) -> BaseStorage:
    """Open a storage: a URL such as "postgresql+psycopg2://..." or "grpc://host:port", else a journal file.

    A database may be unreachable for a minute; a trial without signs of life is lost, and enqueued once more.

    A last line that a killed process left unfinished in a journal is cut off, with a warning.

    Raises:
        ValueError: if it cannot be reached or is no journal.
    """
    if "://" in storage:
        try:
            return _proxy(storage) if storage.startswith("grpc://") else _PatientStorage(_database(storage))
        except Exception as error:  # SQLAlchemy, its drivers and the network raise whatever they like
            reason = without_secrets(_first_line(error), storage)
            raise ValueError(
                f"storage must be a database that can be reached, but got {shown_storage(storage)}: {reason}"
            ) from None
    path = Path(storage).resolve()  # one lock, whichever link leads to a journal
    try:
        if is_misspelt(storage):  # which would become folders, its password their name
            raise ValueError("a URL has :// after its first word")
        if path.exists() and not path.is_file():
            raise ValueError("it is no regular file")
        path.parent.mkdir(parents=True, exist_ok=True)
        # A killed process may leave its lock behind; locks are held for milliseconds.
        lock = JournalFileOpenLock(str(path), grace_period=LOCK_SECONDS)
        lock.acquire()
        try:
            if path.exists():
                cut_unfinished_line(path)
        finally:
            lock.release()
        return JournalStorage(JournalFile(path, lock))
    except (OSError, ValueError, KeyError) as error:
        raise ValueError(
            f"storage must be a journal file that can be written, but got {shown_storage(storage)}: {error}"
        ) from None


def _first_line(error: BaseException) -> str:
    """What an error says first, or what it is called."""
    return (str(error).strip() or type(error).__name__).splitlines()[0]


def _database(url: str) -> RDBStorage:
    """A database, with its tables; tried again when another host makes them at the same time."""
    for _ in range(TABLE_TRIES - 1):
        try:
            return _connected(url)
        except (DBAPIError, AssertionError) as error:
            if isinstance(error, OperationalError) and "already exists" not in str(error):
                raise  # it cannot be reached
            time.sleep(0.5)
    return _connected(url)


def _connected(url: str) -> RDBStorage:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        return RDBStorage(
            url,
            heartbeat_interval=HEARTBEAT_SECONDS,
            grace_period=GRACE_SECONDS,
            engine_kwargs={"connect_args": {"connect_timeout": CONNECT_SECONDS}}
            if WITH_TIMEOUT.match(url)
            else None,
            heartbeat_stale_trial_callback=_retry,
        )


def _retry(study: optuna.Study, trial: FrozenTrial) -> None:
    retry_once(study, trial)


def _proxy(url: str) -> BaseStorage:
    parts = urlsplit(url)
    if parts.hostname is None:
        raise ValueError("it names no host")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        proxy = GrpcStorageProxy(host=parts.hostname, port=parts.port or PROXY_PORT)
    proxy.wait_server_ready(timeout=PROXY_SECONDS)
    return proxy


class Outage:
    """A database that does not answer, for all threads of this process: one deadline for all their calls."""

    def __init__(self):
        """Begin with a database that answers."""
        self._since: float | None = None
        self._failing: set[str] = set()
        self._told = False

    def answered(self, name: str) -> None:
        """Note that a call was answered; one that writes has certainly been so by the database, not by a cache."""
        if self._failing:
            self._failing = set() if not name.startswith(("get", "_get")) else self._failing - {name}
            if not self._failing:
                self._since, self._told = None, False

    def noticed(self, name: str, reason: str) -> None:
        """Note that a call was not answered.

        Raises:
            ValueError: if the database has been away for more than PATIENCE_SECONDS.
        """
        now = time.monotonic()
        since = self._since = now if self._since is None else self._since
        self._failing = self._failing | {name}
        if now > since + PATIENCE_SECONDS:
            raise ValueError(f"a database must answer within {PATIENCE_SECONDS} s, but got: {reason}")

    def tell(self, reason: str) -> None:
        """Say once that there is one."""
        if not self._told:
            self._told = True
            warnings.warn(f"no answer from the database, trying for {PATIENCE_SECONDS} s: {reason}", stacklevel=3)


def _patient(method: Callable) -> Callable:
    """The same method of a storage, called again until the database answers.

    Raises:
        ValueError: if the database is away for more than PATIENCE_SECONDS, whichever call noticed it first.
    """
    name = method.__name__

    @wraps(method)
    def patient(self, *args, **kwargs):
        for attempt in count():
            try:
                answer = method(self, *args, **kwargs)
                self.outage.answered(name)
                return answer
            except UpdateFinishedTrialError:
                self.outage.answered(name)
                if not attempt:
                    raise
                return True  # the attempt whose answer got lost has done its work
            except StorageInternalError as error:
                reason = without_secrets(_first_line(error.__cause__ or error), self._backend.url)
            self.outage.noticed(name, reason)
            if attempt == 1:  # the first may have met a connection from before an outage
                self.outage.tell(reason)
            time.sleep(0.5)

    return patient


def _all_patient(storage: type) -> type:
    for name in BaseStorage.__abstractmethods__ | BaseHeartbeat.__abstractmethods__:
        if name not in vars(storage):
            setattr(storage, name, _patient(getattr(storage, name)))
    return storage


@_all_patient
class _PatientStorage(_CachedStorage):
    """Optuna's cached storage of a database, whose calls are repeated until the database answers."""

    def __init__(self, database: RDBStorage):
        super().__init__(database)
        self.outage = Outage()

    def record_heartbeat(self, trial_id: int) -> None:
        """Give one sign of life; where it gets lost the next one follows soon, and other calls find out why."""
        try:
            super().record_heartbeat(trial_id)
            self.outage.answered("record_heartbeat")
        except StorageInternalError as error:
            with contextlib.suppress(ValueError):  # the thread that runs the trial has to end it
                self.outage.noticed("record_heartbeat", str(error))


def this_process() -> str:
    """Name of this process for trials that it runs: host and process number."""
    return f"{os.uname().nodename}:{os.getpid()}"


def retry_orphans(study: optuna.Study) -> int:
    """Fail running trials whose process on this host is gone, and enqueue each once more; return how many."""
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
    """Enqueue a lost trial once more, unless it is a second try or has no parameters yet; return whether so."""
    if RETRY_OF in trial.user_attrs or not trial.params:
        return False
    study.enqueue_trial(trial.params, user_attrs={RETRY_OF: trial.number})
    return True


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
    return host != os.uname().nodename or _alive(int(number))


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
