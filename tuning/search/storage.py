"""Where studies are stored: a journal file by default, which is safe to resume; a database for several machines.

In order: URLs in messages, databases, journal files, running trials.
"""

from __future__ import annotations

import contextlib
import copy
import ctypes
import json
import os
import platform
import re
import sys
import time
import uuid
import warnings
from collections.abc import Callable, Generator
from contextlib import ExitStack, suppress
from functools import wraps
from itertools import count
from pathlib import Path
from typing import Any
from urllib.parse import unquote_plus, urlsplit

import optuna
from optuna.exceptions import StorageInternalError, UpdateFinishedTrialError
from optuna.storages import BaseStorage, GrpcStorageProxy, JournalStorage, RDBStorage
from optuna.storages._cached_storage import _CachedStorage
from optuna.storages._heartbeat import BaseHeartbeat
from optuna.storages.journal import JournalFileBackend, JournalFileOpenLock
from optuna.trial import FrozenTrial, TrialState, create_trial

from thruster_env.core.checks import short_repr

# Of URLs, of which messages contain scheme, host and database, but not user, password or options.
HIDDEN = "***"
DATABASES = ("postgresql", "postgres", "mysql", "mariadb", "sqlite", "oracle", "mssql", "redis", "grpc")
_SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*")
_ADDRESS = re.compile(r"(?P<host>[\w.-]*|\[[0-9A-Fa-f:.]+\])(?P<port>:\d+)?(?P<database>/[^:@]*)?", re.ASCII)
_MARKS = re.compile(r"[:/@?#&=;,\s]+")
_MISSPELT = re.compile(rf"({'|'.join(DATABASES)})(\+\w+)?:(?!//)", re.IGNORECASE)

# Of databases.
DRIVER = "pip install '.[db]' in the project's folder, and postgresql+psycopg2:// in the URL"
TABLE_TRIES = 5  # to make the tables of a database, or to find them made
PATIENCE_SECONDS = 60  # for which a database may be away
CONNECT_SECONDS = 10  # timeout of a connection, for drivers that have one
WITH_TIMEOUT = re.compile(r"(postgresql(\+psycopg2?)?|(mysql|mariadb)(\+(pymysql|mysqldb))?)://")
HEARTBEAT_SECONDS = 10  # between two signs of life of a running trial in a database
GRACE_SECONDS = 180  # without one, after which it counts as lost; an outage is shorter
PROXY_PORT, PROXY_SECONDS = 13000, 10  # the default port of a proxy, and the time in which it has to answer
MARK = "made by call"  # system attribute of a trial, by which a repeated call finds what the first one made
OnLost = Callable[[optuna.Study, FrozenTrial], Any]  # of a module: storages are pickled

# Of journal files.
INTERMEDIATE = "intermediate_value"  # key of an entry of Optuna's with the value of a seed
BEGINNING = b'{"op_code":'  # of each entry of a journal

# Of locks and running trials.
LOCK_SECONDS = 5  # after which a lock counts as left behind
SIGNATURE_SECONDS = 2 * LOCK_SECONDS  # by which a living process has signed its trial
SYNCHRONIZE, ACCESS_DENIED, WAIT_TIMEOUT = 0x00100000, 5, 0x102  # of Windows: a right, an error, an answer
PROCESS, RETRY_OF = "process", "retry_of"  # trial attributes: who runs it, and which one it repeats


def public_url(storage: str) -> str:
    """A storage for messages: a path as it is, of a URL scheme, host, port and database.

    For an ambiguous URL, such as one with a question mark in the password, only the scheme is shown.
    """
    scheme, separator, rest = storage.partition("://")
    if not separator:
        misspelt = _MISSPELT.match(storage)
        return storage if misspelt is None else f"{misspelt[0]}{HIDDEN}"
    if not _SCHEME.fullmatch(scheme):
        return HIDDEN
    address = _address(rest)
    return f"{scheme}://{HIDDEN if address is None else address}"


def is_misspelt(storage: str) -> bool:
    """Whether this is a database's URL except for its slashes, and not a path."""
    return bool(_MISSPELT.match(storage))


def _address(rest: str) -> str | None:
    """Host, port and database of what follows a scheme, None where it is not sure which part they are."""
    if rest.startswith("/"):  # no host, and so no user
        return re.split(r"[?#]", rest, maxsplit=1)[0]
    before, at, after = rest.rpartition("@")
    if at and re.search(r"[?#]", before):
        return None
    address = re.split(r"[?#]", after, maxsplit=1)[0]
    return address if _ADDRESS.fullmatch(address) else None


def without_secrets(text: str, storage: str) -> str:
    """A message of a database or its driver without the hidden parts of the storage's URL."""
    public = public_url(storage)
    if public == storage:
        return text
    rest = storage.partition("://")[2]
    if rest.startswith("/"):
        login, address = "", rest
    elif public.endswith(HIDDEN):  # any part may be a password
        address = storage if public == HIDDEN else storage.partition(":")[2]
        login = f":{address}"
    else:
        login, _, address = rest.rpartition("@")
    options = [option.partition("=")[2] for option in re.split(r"[?#&;]", address)[1:]]
    secrets = {
        part for candidate in (login.partition(":")[2], *options) for part in (candidate, unquote_plus(candidate))
    }
    # A driver that reads the URL in another way may name a part of a password, as that before its slash.
    secrets |= {word for secret in secrets for word in _MARKS.split(secret)} - {*_MARKS.split(public)}
    text = text.replace(storage, public)
    for secret in sorted(secrets - {""}, key=len, reverse=True):
        text = re.sub(rf"(?<!\w){re.escape(secret)}(?!\w)", HIDDEN, text)
    return text


def first_line(error: BaseException) -> str:
    """The first line of an error, or its class's name."""
    return (str(error).strip() or type(error).__name__).splitlines()[0]


def open_database(url: str, on_lost: OnLost) -> BaseStorage:
    """Open a database, or the proxy of one, "grpc://host:port"; any error that SQLAlchemy or its drivers raise.

    Args:
        url: of the database.
        on_lost: called with a study and one of its trials whose heartbeat has stopped.
    """
    return _proxy(url) if url.startswith("grpc://") else _PatientStorage(_database(url, on_lost))


def _database(url: str, on_lost: OnLost) -> RDBStorage:
    """A database, with its tables; tried again when another host makes them at the same time."""
    from sqlalchemy.exc import DBAPIError, OperationalError  # takes 0.2 s, which journal files need not wait for

    for _ in range(TABLE_TRIES - 1):
        try:
            return _connected(url, on_lost)
        except (DBAPIError, AssertionError) as error:
            if isinstance(error, OperationalError) and "already exists" not in str(error):
                raise  # it cannot be reached
            time.sleep(0.5)
    return _connected(url, on_lost)


def _connected(url: str, on_lost: OnLost) -> RDBStorage:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        return RDBStorage(
            url,
            heartbeat_interval=HEARTBEAT_SECONDS,
            grace_period=GRACE_SECONDS,
            engine_kwargs={"connect_args": {"connect_timeout": CONNECT_SECONDS}}
            if WITH_TIMEOUT.match(url)
            else None,
            heartbeat_stale_trial_callback=on_lost,
        )


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
        """Note that a call was answered: if it writes, certainly by the database, not by a cache."""
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
                reason = without_secrets(first_line(error.__cause__ or error), self._backend.url)
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


@_patient
def _make_once(self: _PatientStorage, study_id: int, template: FrozenTrial, tries: list[bool]) -> int:
    """Make a marked trial, unless an earlier try, whose answer got lost, has made it."""
    if tries:
        mark = template.system_attrs[MARK]
        for trial in self.get_all_trials(study_id, deepcopy=False):
            if trial.system_attrs.get(MARK) == mark:
                return trial._trial_id
    tries.append(True)
    return _CachedStorage.create_new_trial(self, study_id, template)


@_all_patient
class _PatientStorage(_CachedStorage):
    """Optuna's cached storage of a database, whose calls are repeated until the database answers."""

    def __init__(self, database: RDBStorage):
        super().__init__(database)
        self.outage = Outage()

    def create_new_trial(self, study_id: int, template_trial: FrozenTrial | None = None) -> int:
        """Make one trial: it bears a mark, lest a call that is repeated makes it twice, and it runs twice."""
        template = copy.deepcopy(template_trial) or create_trial(state=TrialState.RUNNING)
        template.system_attrs[MARK] = uuid.uuid4().hex
        return _make_once(self, study_id, template, [])

    def record_heartbeat(self, trial_id: int) -> None:
        """Give one sign of life; where it gets lost the next one follows soon, and other calls find out why."""
        try:
            super().record_heartbeat(trial_id)
            self.outage.answered("record_heartbeat")
        except StorageInternalError as error:
            with contextlib.suppress(ValueError):  # the thread that runs the trial has to end it
                self.outage.noticed("record_heartbeat", str(error))


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
            is_entry = line.endswith(b"\n") and isinstance(json.loads(line), dict)
        except ValueError:
            is_entry = False
        if is_entry:
            continue
        if number < len(lines):
            raise ValueError(f"line {number} is no journal entry")
        if number == 1 and (line.endswith(b"\n") or line[: len(BEGINNING)] != BEGINNING[: len(line)]):
            raise ValueError("it is no journal")
        warnings.warn(f"{path}: cut off its last line, which a process left unfinished", stacklevel=4)
        with path.open("r+b") as stream:
            stream.truncate(len(content) - len(line))


def open_storage(storage: Any) -> BaseStorage:
    """Open a storage: a URL such as "postgresql+psycopg2://..." or "grpc://host:port", else a journal file.

    A database may be unreachable for a minute; a trial without a heartbeat is lost, and enqueued again.

    A last line that a killed process left unfinished in a journal is cut off, with a warning.

    Raises:
        ValueError: if it cannot be reached, is no journal, or is neither text nor a path.
    """
    storage = storage_text(storage)
    if "://" in storage:
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
    return f"{platform.node()}:{os.getpid()}"


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
    return host != platform.node() or is_alive(int(number))


def is_alive(process: int) -> bool:
    """Whether there is a process of this number on this host."""
    if process <= 0:
        return False
    if sys.platform == "win32":  # where os.kill would end it
        return _is_alive_on_windows(process)
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def _is_alive_on_windows(process: int) -> bool:
    library = ctypes.WinDLL("kernel32", use_last_error=True)  # type: ignore[attr-defined]
    library.OpenProcess.restype = ctypes.c_void_p
    handle = ctypes.c_void_p(library.OpenProcess(SYNCHRONIZE, False, process))
    if not handle:
        return ctypes.get_last_error() == ACCESS_DENIED  # type: ignore[attr-defined]
    try:
        return library.WaitForSingleObject(handle, 0) == WAIT_TIMEOUT
    finally:
        library.CloseHandle(handle)


def quiet_optuna() -> ExitStack:
    """Let Optuna report errors only, since we show our own progress: from now on, or within the context."""
    before, context = optuna.logging.get_verbosity(), ExitStack()
    context.callback(optuna.logging.set_verbosity, before)
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    return context
