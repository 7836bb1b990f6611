"""Databases as storages: tables, signs of life, lost answers, an end of patience, the proxy."""

import socket
import subprocess
import sys
import time

import optuna
import pytest
import sqlalchemy
from optuna.trial import TrialState
from rich.console import Console

from tuning.api.tune import run_tuning
from tuning.plants.thruster import find_scenario
from tuning.problems.find import find_problem
from tuning.search import storage as database
from tuning.search.plan import Plan
from tuning.search.space import distributions
from tuning.search.storage import PROCESS, RETRY_OF, open_storage, retry_once
from tuning.search.study import open_study, run_study

PLAN = Plan("ekf", (find_scenario("mismatch"),), prune=False)


@pytest.mark.filterwarnings("ignore:Heartbeat of storage is supposed to be used with Study.optimize")
def test_a_trial_without_a_heartbeat_is_lost_and_tried_once_more(tmp_path, monkeypatch):
    monkeypatch.setattr(database, "HEARTBEAT_SECONDS", 1)
    monkeypatch.setattr(database, "GRACE_SECONDS", 1)
    storage = open_storage(f"sqlite:///{tmp_path}/s.db")
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
    assert not open_study("s", PLAN, open_storage(url)).trials[0].params
    assert len(tries) == 3


@pytest.fixture
def flaky(tmp_path, monkeypatch):
    """Makes a database do its work and fail to say so, as often as told."""
    storage = open_storage(f"sqlite:///{tmp_path}/s.db")

    def fail(name, times):
        method, failures = getattr(storage._backend, name), iter(range(times))

        def lost(*args, **kwargs):
            answer = method(*args, **kwargs)
            if next(failures, None) is not None:
                raise optuna.exceptions.StorageInternalError("connection lost")
            return answer

        monkeypatch.setattr(storage._backend, name, lost)

    return storage, fail


@pytest.mark.filterwarnings("ignore:Heartbeat of storage is supposed to be used with Study.optimize")
def test_an_answer_that_gets_lost_is_asked_for_again(flaky):
    storage, fail = flaky
    study = optuna.create_study(storage=storage)
    trial = study.ask()
    fail("set_trial_state_values", 1)
    study.tell(trial, 1.0)
    assert [trial.values for trial in study.trials] == [[1.0]]
    with pytest.raises(ValueError):  # what is finished cannot be told twice
        study.tell(trial.number, 1.0)


@pytest.mark.filterwarnings("ignore:Heartbeat of storage is supposed to be used with Study.optimize")
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
    study = optuna.create_study(storage=open_storage(str(tmp_path / "j")))
    study.enqueue_trial({"a": 0.5})
    study.ask()  # by a process that ends now: it never signs
    assert retry_once(study, study.trials[0])
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


def test_a_driver_that_is_missing_is_named_with_the_extra_that_brings_it():
    with pytest.raises(
        ValueError, match=r"but got postgresql\+pg8000://host/s: .*: pip install '\.\[db\]' in the"
    ):
        open_storage("postgresql+pg8000://host/s")


def test_several_workers_on_sqlite_are_warned(monkeypatch):
    monkeypatch.setattr("tuning.api.tune.checked", lambda plan: open_storage(""))  # ends here
    plan, console = Plan("ekf", (find_problem("nominal"),)), Console(quiet=True)
    with (
        pytest.warns(UserWarning, match="so 2 workers wait for each other"),
        pytest.raises(ValueError, match="stor"),
    ):
        run_tuning(plan, 3, console, "sqlite:///s.db", workers=2)


def test_a_proxy_must_have_a_host():
    with pytest.raises(ValueError, match="got grpc://:13000: it names no host"):
        open_storage("grpc://:13000")


@pytest.mark.slow
def test_a_proxy_stands_between_a_study_and_its_database(tmp_path, monkeypatch):
    pytest.importorskip("grpc")
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = free.getsockname()[1]
    monkeypatch.setattr(database, "PROXY_SECONDS", 0.1)
    with pytest.raises(ValueError, match="storage must be a database that can be reached, but got grpc:"):
        open_storage(f"grpc://localhost:{port}")
    program = "import sys, optuna; optuna.storages.run_grpc_proxy_server("
    program += "optuna.storages.RDBStorage(sys.argv[1]), port=int(sys.argv[2]))"
    url = f"sqlite:///{tmp_path}/s.db"
    server = subprocess.Popen([sys.executable, "-c", program, url, str(port)], stderr=subprocess.DEVNULL)
    try:
        monkeypatch.setattr(database, "PROXY_SECONDS", 30)
        result = run_study(open_study("s", PLAN, open_storage(f"grpc://localhost:{port}")), PLAN, 3)
        assert [trial.state for trial in result.trials] == [TrialState.COMPLETE] * 3
    finally:
        server.terminate()
        server.wait()
