"""Databases as storages of studies, tolerant of outages, and their proxy.

Only a study in a database loads SQLAlchemy, which takes a tenth of a second.
"""

from __future__ import annotations

import contextlib
import copy
import re
import time
import uuid
import warnings
from collections.abc import Callable
from functools import wraps
from itertools import count
from typing import Any
from urllib.parse import urlsplit

import optuna
from optuna.exceptions import StorageInternalError, UpdateFinishedTrialError
from optuna.storages import BaseStorage, GrpcStorageProxy, RDBStorage
from optuna.storages._cached_storage import _CachedStorage
from optuna.storages._heartbeat import BaseHeartbeat
from optuna.trial import FrozenTrial, TrialState, create_trial
from sqlalchemy.exc import DBAPIError, OperationalError

from tuning.search.storage_url import first_line, without_secrets

TABLE_TRIES = 5  # to make the tables of a database, or to find them made
PATIENCE_SECONDS = 60  # for which a database may be away
CONNECT_SECONDS = 10  # timeout of a connection, for drivers that have one
WITH_TIMEOUT = re.compile(r"(postgresql(\+psycopg2?)?|(mysql|mariadb)(\+(pymysql|mysqldb))?)://")
HEARTBEAT_SECONDS = 10  # between two signs of life of a running trial in a database
GRACE_SECONDS = 180  # without one, after which it counts as lost; an outage is shorter
PROXY_PORT, PROXY_SECONDS = 13000, 10  # the default port of a proxy, and the time in which it has to answer
MARK = "made by call"  # system attribute of a trial, by which a repeated call finds what the first one made
OnLost = Callable[[optuna.Study, FrozenTrial], Any]  # of a module: storages are pickled


def open_database(url: str, on_lost: OnLost) -> BaseStorage:
    """Open a database, or the proxy of one, "grpc://host:port"; any error that SQLAlchemy or its drivers raise.

    Args:
        url: of the database.
        on_lost: called with a study and one of its trials whose heartbeat has stopped.
    """
    return _proxy(url) if url.startswith("grpc://") else _PatientStorage(_database(url, on_lost))


def _database(url: str, on_lost: OnLost) -> RDBStorage:
    """A database, with its tables; tried again when another host makes them at the same time."""
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
