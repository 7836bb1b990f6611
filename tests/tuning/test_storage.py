"""Databases as storages: tables, signs of life, lost answers, one deadline, the proxy, no password in messages."""

import re
import socket
import subprocess
import sys
import time
import types

import optuna
import pytest
import sqlalchemy
from optuna.trial import TrialState
from rich.console import Console

from tests.filters.checks import refused
from tuning.api.report import find_subject
from tuning.api.tune import run_tuning
from tuning.plants.thruster import find_scenario
from tuning.problems.find import find_problem
from tuning.search import storage as database
from tuning.search.plan import Plan
from tuning.search.space import distributions
from tuning.search.storage import PATIENCE_SECONDS, PROCESS, RETRY_OF
from tuning.search.study import open_study, run_study, run_trials

PLAN = Plan("ekf", (find_scenario("mismatch"),), prune=False)
pytestmark = pytest.mark.filterwarnings("ignore:Heartbeat of storage is supposed to be used with")


def test_a_trial_without_a_heartbeat_is_lost_and_tried_once_more(tmp_path, monkeypatch):
    monkeypatch.setattr(database, "HEARTBEAT_SECONDS", 1)
    monkeypatch.setattr(database, "GRACE_SECONDS", 1)
    storage = database.open_storage(f"sqlite:///{tmp_path}/s.db")
    study = open_study("s", PLAN, storage)
    trial = study.ask(distributions("ekf", PLAN.scenarios[0]))
    trial.set_user_attr(PROCESS, "elsewhere:1")
    storage.record_heartbeat(trial._trial_id)
    time.sleep(2.5)
    found = run_study(open_study("s", PLAN, storage), PLAN, 2).trials
    assert found[0].state == TrialState.FAIL
    assert [t.params for t in found if t.user_attrs.get(RETRY_OF) == 0] == [found[0].params]


def test_tables_that_another_host_is_making_are_found_in_the_end(tmp_path, monkeypatch):
    url, connected, tries = f"sqlite:///{tmp_path}/s.db", database._connected, []

    def half_made(url, on_lost):
        tries.append(url)
        if len(tries) < 3:
            raise sqlalchemy.exc.OperationalError("CREATE", {}, Exception("Table 'studies' already exists"))
        return connected(url, on_lost)

    monkeypatch.setattr(database, "_connected", half_made)
    assert not open_study("s", PLAN, database.open_storage(url)).trials[0].params
    assert len(tries) == 3


@pytest.fixture
def flaky(tmp_path, monkeypatch):
    """Makes a database do its work and fail to say so, as often as told."""
    storage = database.open_storage(f"sqlite:///{tmp_path}/s.db")

    def fail(name, times):
        method, failures = getattr(storage._backend, name), iter(range(times))

        def lost(*args, **kwargs):
            answer = method(*args, **kwargs)
            if next(failures, None) is not None:
                raise optuna.exceptions.StorageInternalError("connection lost")
            return answer

        monkeypatch.setattr(storage._backend, name, lost)

    return storage, fail


def test_an_answer_that_gets_lost_is_asked_for_again(flaky):
    storage, fail = flaky
    study = optuna.create_study(storage=storage)
    trial = study.ask()
    fail("set_trial_state_values", 1)
    study.tell(trial, 1.0)
    assert [trial.values for trial in study.trials] == [[1.0]]
    with pytest.raises(ValueError):  # what is finished cannot be told twice
        study.tell(trial.number, 1.0)


def test_a_trial_whose_making_was_not_answered_is_made_once(flaky):
    storage, fail = flaky
    study = optuna.create_study(storage=storage)
    fail("_create_new_trial", 1)
    study.enqueue_trial({"a": 0.5}, user_attrs={"kind": "given"})
    assert [(t.state.name, t.user_attrs) for t in study.trials] == [("WAITING", {"kind": "given"})]
    study.enqueue_trial({"a": 0.5})  # what is asked for twice is made twice
    assert len(study.trials) == 2
    popped = study.ask()
    assert popped.number == 0 and popped.suggest_float("a", 0.0, 1.0) == 0.5
    study.ask()
    fail("_create_new_trial", 1)
    running = study.ask()
    assert running.number == 2 and [t.state.name for t in study.trials] == ["RUNNING"] * 3
    study.tell(running, 1.0)


def test_an_enqueued_trial_that_was_lost_before_its_first_parameter_is_enqueued_again(tmp_path):
    study = optuna.create_study(storage=database.open_storage(str(tmp_path / "j")))
    study.enqueue_trial({"a": 0.5})
    study.ask()  # by a process that ends now: it never signs
    assert database.retry_once(study, study.trials[0])
    again = study.ask()
    assert again.user_attrs == {RETRY_OF: 0} and again.suggest_float("a", 0.0, 1.0) == 0.5


def test_patience_has_an_end(flaky, monkeypatch):
    storage, fail = flaky
    study = optuna.create_study(storage=storage)
    monkeypatch.setattr(database, "PATIENCE_SECONDS", 1)
    fail("set_study_user_attr", 100)
    with (
        pytest.warns(UserWarning, match="no answer from the database, trying for 1 s: connection lost"),
        pytest.raises(ValueError, match="a database must answer within 1 s, but got: connection lost"),
    ):
        study.set_user_attr("a", 1)


def test_a_missing_driver_and_a_proxy_without_a_host_are_named():
    with pytest.raises(ValueError, match=r"but got postgresql\+pg8000://host/s: .*: pip install '\.\[db\]' in"):
        database.open_storage("postgresql+pg8000://host/s")
    refused("got grpc://:13000: it names no host", database.open_storage, "grpc://:13000")


def test_several_workers_on_sqlite_are_warned(monkeypatch):
    monkeypatch.setattr("tuning.api.tune.checked", lambda plan: database.open_storage(""))  # ends here
    plan, console = Plan("ekf", (find_problem("nominal"),)), Console(quiet=True)
    with pytest.warns(UserWarning, match="so 2 workers wait"), pytest.raises(ValueError, match="stor"):
        run_tuning(plan, 3, console, "sqlite:///s.db", workers=2)


@pytest.mark.slow
def test_a_proxy_stands_between_a_study_and_its_database(tmp_path, monkeypatch):
    pytest.importorskip("grpc")
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = free.getsockname()[1]
    monkeypatch.setattr(database, "PROXY_SECONDS", 0.1)
    with pytest.raises(ValueError, match="storage must be a database that can be reached, but got grpc:"):
        database.open_storage(f"grpc://localhost:{port}")
    program = "import sys, optuna; optuna.storages.run_grpc_proxy_server("
    program += "optuna.storages.RDBStorage(sys.argv[1]), port=int(sys.argv[2]))"
    url = f"sqlite:///{tmp_path}/s.db"
    server = subprocess.Popen([sys.executable, "-c", program, url, str(port)], stderr=subprocess.DEVNULL)
    try:
        monkeypatch.setattr(database, "PROXY_SECONDS", 30)
        result = run_study(open_study("s", PLAN, database.open_storage(f"grpc://localhost:{port}")), PLAN, 3)
        assert [trial.state for trial in result.trials] == [TrialState.COMPLETE] * 3
    finally:
        server.terminate()
        server.wait()


WRITES = ("set_trial_user_attr", "set_trial_state_values", "set_study_user_attr", "record_heartbeat")


class Clock:
    """Time that passes when somebody sleeps."""

    def __init__(self):
        self.now, self.alarm = 0.0, (float("inf"), None)

    def monotonic(self):
        return self.now

    def sleep(self, seconds):
        self.now += seconds
        if self.now >= self.alarm[0]:
            self.alarm[1]()


@pytest.fixture
def clock(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(database, "time", types.SimpleNamespace(monotonic=clock.monotonic, sleep=clock.sleep))
    return clock


@pytest.fixture
def storage(tmp_path):
    return database.open_storage(f"sqlite:///{tmp_path}/s.db")


@pytest.fixture
def refuse(storage, monkeypatch):
    """Makes a database refuse some of its methods, until it is told otherwise."""
    away = types.SimpleNamespace(methods=())

    def refusing(name, method):
        def call(*args, **kwargs):
            if name in away.methods:
                raise optuna.exceptions.StorageInternalError("read-only transaction")
            return method(*args, **kwargs)

        return call

    for name in (*WRITES, "get_all_trials"):
        monkeypatch.setattr(storage._backend, name, refusing(name, getattr(storage._backend, name)))
    return lambda *methods: setattr(away, "methods", methods)


@pytest.mark.filterwarnings("ignore:no answer from the database")
def test_one_deadline_counts_for_all_calls(storage, refuse, clock):
    study = optuna.create_study(storage=storage)
    refuse(*WRITES)
    rule = f"a database must answer within {PATIENCE_SECONDS} s, but got: read-only transaction"
    refused(rule, study.set_user_attr, "a", 1)
    assert PATIENCE_SECONDS < clock.now <= PATIENCE_SECONDS + 1
    for _ in range(3):  # each would have had a minute of its own
        assert study.get_trials() == []  # reading works, and is no sign that writing does
        refused(rule, study.set_user_attr, "b", 1)
    assert clock.now <= PATIENCE_SECONDS + 1


def test_after_an_outage_the_next_one_has_a_deadline_of_its_own(storage, refuse, clock):
    study = optuna.create_study(storage=storage)
    for _ in range(2):
        refuse(*WRITES)
        clock.now, clock.alarm = 0.0, (50.0, refuse)  # which then refuses nothing
        with pytest.warns(UserWarning, match="no answer from the database, trying for 60 s: read-only") as told:
            study.set_user_attr("a", 1)
        assert len(told) == 1 and 50 <= clock.now < 52


def test_a_sign_of_life_that_gets_lost_ends_no_thread(storage, refuse, clock):
    study = optuna.create_study(storage=storage)
    number = storage.create_new_trial(study._study_id)
    refuse("record_heartbeat")
    for _ in range(20):
        storage.record_heartbeat(number)
        clock.now += 10.0
    refuse()
    storage.record_heartbeat(number)
    refuse("set_study_user_attr")
    before = clock.now
    with pytest.warns(UserWarning, match="no answer"), pytest.raises(ValueError, match="must answer within 60 s"):
        study.set_user_attr("a", 1)  # the outage of before is over
    assert clock.now > before + PATIENCE_SECONDS


@pytest.mark.filterwarnings("ignore:no answer from the database")
@pytest.mark.parametrize("refused", [WRITES, (*WRITES, "get_all_trials")])
def test_a_study_whose_database_stays_away_ends_with_what_it_said(storage, refuse, clock, capfd, refused):
    study = open_study("s", PLAN, storage)

    def after(study, finished):
        if finished == 2:
            refuse(*refused)

    with pytest.raises(ValueError, match="a database must answer within 60 s, but got: read-only"):
        run_trials(study, PLAN, PLAN.training_data(), 5, after)
    assert clock.now <= PATIENCE_SECONDS + 1
    assert "Traceback" not in capfd.readouterr().err
    refuse()
    assert sum(trial.state.is_finished() for trial in study.get_trials()) == 2


SHOWN = {
    "postgresql+psycopg2://tuner:secret@host:5432/studies": "postgresql+psycopg2://host:5432/studies",
    "postgresql://tuner@10.77.5.1/studies": "postgresql://10.77.5.1/studies",
    "postgresql://host/studies?user=tuner&password=secret": "postgresql://host/studies",
    "postgresql://tuner@host/studies?password=se@cret": "postgresql://***",
    "postgresql:///studies?host=/run&password=se@cret": "postgresql:///studies",
    "postgresql://tuner:se/cret@host/studies": "postgresql://host/studies",
    "postgresql://tuner:se@cret@host/studies": "postgresql://host/studies",
    "postgresql://tuner:se/cr@et@host:5432/studies?sslmode=require": "postgresql://host:5432/studies",
    "postgresql://tuner:se?cret@host/studies": "postgresql://***",
    "postgresql://tuner:se#cret@host/studies": "postgresql://***",
    "postgresql://tuner:secret/studies": "postgresql://***",
    "postgresql://tuner:secret": "postgresql://***",
    "postgresql://tuner:secret@[::1]:5432/studies": "postgresql://[::1]:5432/studies",
    "mysql+pymysql://tuner:se%40cret@host/studies": "mysql+pymysql://host/studies",
    "tuner:secret@host://studies": "***",
    "postgresql:/tuner:secret@host/studies": "postgresql:***",
    "postgresql+psycopg2:tuner:secret@host/studies": "postgresql+psycopg2:***",
    "grpc://tuner:secret@host:13000": "grpc://host:13000",
    "sqlite:////data/a@b/s.db?password=secret": "sqlite:////data/a@b/s.db",
    "out/studies.journal": "out/studies.journal",
    "/data/a@b/studies.journal": "/data/a@b/studies.journal",
    "postgresql/studies.journal": "postgresql/studies.journal",
}


@pytest.mark.parametrize(("storage", "shown"), SHOWN.items(), ids=list(SHOWN))
def test_scheme_host_and_database_are_shown_and_nothing_else(storage, shown):
    assert database.public_url(storage) == shown
    said = f"could not connect to {storage}: password secret, or cret@host, or se"
    said = database.without_secrets(said, storage)
    if shown != storage:
        assert storage not in said and shown in said
        assert not re.search(r"\bsecret\b|se.cret", said) or "secret" not in storage


@pytest.mark.parametrize(
    ("storage", "said", "clean"),
    [
        (
            "postgresql://tuner:pa@ss@host/studies",  # as SQLAlchemy hands the rest to a driver
            'could not translate host name "ss@host" to address',
            'could not translate host name "***@host" to address',
        ),
        ("grpc://tuner:secret/x", "Port could not be cast to integer value as 'secret'", "value as '***'"),
        ("mysql://tuner:p%40ss@host/s", "access denied with p@ss or p%40ss, passed", "with *** or ***, passed"),
        ("postgresql://host/s?password=hush", 'dsn: "host=host password=hush"', '"host=host password=***"'),
        ("postgresql://tuner:pw@host/s", 'authentication failed for user "tuner"', 'for user "tuner"'),
        ("out/studies.journal", "a journal: out", "a journal: out"),
    ],
)
def test_a_message_loses_every_part_of_a_password(storage, said, clean):
    assert database.without_secrets(said, storage).endswith(clean)


SECRET = [
    "postgresql+psycopg2://tuner:secret@localhost:1/s",
    "postgresql+psycopg2://localhost:1/s?user=tuner&password=secret",
    "postgresql+psycopg2://tuner:sec/secret@localhost:1/s",
    "postgresql+psycopg2://tuner:sec@secret@localhost:1/s",
    "postgresql+psycopg2://tuner:secret/s",
    "grpc://tuner:secret/s",
    "nonsense://tuner:secret@localhost/s",
    "postgresql:/tuner:secret@localhost/s",
    "sqlite:////no/such/folder/x.db",
]


@pytest.mark.parametrize("url", SECRET)
def test_a_storage_that_cannot_be_reached_tells_no_password(url, tmp_path, monkeypatch):
    pytest.importorskip("psycopg2")
    pytest.importorskip("grpc")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(database, "PROXY_SECONDS", 0.01)
    scheme = url.partition(":")[0].replace("+", ".")
    with pytest.raises(ValueError, match=f"storage must be .* but got {scheme}:") as e:
        database.open_storage(url)
    assert "secret" not in str(e.value) and "tuner:" not in str(e.value) and "\n" not in str(e.value)
    assert not list(tmp_path.iterdir())


def test_an_outage_tells_no_password(tmp_path, monkeypatch):
    monkeypatch.setattr(database, "PATIENCE_SECONDS", 0.6)
    storage, url = database.open_storage(f"sqlite:///{tmp_path}/s.db"), "postgresql://tuner:secret@host/s"
    study = optuna.create_study(storage=storage)

    def away(*arguments):
        cause = sqlalchemy.exc.OperationalError("SELECT 1", {}, Exception(f"no answer from {url}"))
        raise optuna.exceptions.StorageInternalError("away") from cause

    monkeypatch.setattr(storage._backend, "url", url)
    monkeypatch.setattr(storage._backend, "set_study_user_attr", away)
    said = "no answer from postgresql://host/s$"
    with pytest.warns(UserWarning, match=said), pytest.raises(ValueError, match=said):
        study.set_user_attr("a", 1)


def test_a_report_of_a_study_that_is_not_there_tells_no_password(monkeypatch):
    monkeypatch.setattr("tuning.api.report._load", lambda name, storage: None)
    with pytest.raises(ValueError, match="of a study in postgresql://host/s, but got 'none'"):
        find_subject("none", "postgresql://tuner:secret@host/s")
