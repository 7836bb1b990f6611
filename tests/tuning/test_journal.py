"""A journal is synchronised where a trial ends, what the running one reports waits; a full disk loses no line."""

import errno
import json
import os
import pickle
import resource
import signal
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import optuna
import pytest
from optuna.trial import TrialState

from tests.filters.checks import refused
from tuning.plants.thruster import find_scenario
from tuning.search.plan import Plan
from tuning.search.storage import JournalFile, open_storage
from tuning.search.study import finished_trials, open_study, run_trials
from tuning.search.workers import orders_of


@pytest.fixture
def path(tmp_path):
    return str(tmp_path / "studies.journal")


def reporting(trial):
    """Reports two seeds in a block; every other trial is pruned after it."""
    x = trial.suggest_float("x", 0.0, 1.0)
    for step in range(2):
        trial.report(x + step, step)
    if trial.number % 2:
        raise optuna.TrialPruned
    trial.report(x + 2, 2)
    return x


def test_another_process_finds_every_value_of_finished_trials(path):
    study = optuna.create_study(study_name="s", storage=open_storage(path))
    study.optimize(reporting, n_trials=4)
    trials = optuna.load_study(study_name="s", storage=open_storage(path)).trials
    assert [trial.state for trial in trials] == 2 * [TrialState.COMPLETE, TrialState.PRUNED]
    for trial in trials:
        x = trial.params["x"]
        pruned = trial.state == TrialState.PRUNED
        assert trial.intermediate_values == {step: x + step for step in range(2 if pruned else 3)}
        assert trial.value == (x + 1 if pruned else x)
    assert trials == study.trials


def test_a_reader_in_the_same_process_finds_what_was_reported(path):
    study = optuna.create_study(study_name="s", storage=open_storage(path))
    trial = study.ask()
    trial.report(3.0, 0)
    trial.report(4.0, 1)
    assert study.trials[0].intermediate_values == {0: 3.0, 1: 4.0}
    (found,) = optuna.load_study(study_name="s", storage=open_storage(path)).trials
    assert found.intermediate_values == {0: 3.0, 1: 4.0}


def test_the_file_is_synchronised_once_a_trial_and_seeds_are_added_together(path, monkeypatch):
    study = optuna.create_study(study_name="s", storage=open_storage(path))
    synchronised, added, fsync, write = [], [], os.fsync, JournalFile._write

    def written(self, logs):
        added.append(len(self._waiting))
        write(self, logs)

    monkeypatch.setattr(os, "fsync", lambda number: (synchronised.append(number), fsync(number)))
    monkeypatch.setattr(JournalFile, "_write", written)
    study.optimize(reporting, n_trials=4)
    assert len(synchronised) == 4
    assert sorted(count for count in added if count) == [2, 2, 3, 3]
    study.set_user_attr("best", 1)
    assert len(synchronised) == 5


def test_what_waits_is_gone_if_it_finds_no_room(path, monkeypatch):
    study = optuna.create_study(study_name="s", storage=open_storage(path))
    trial = study.ask()
    trial.report(3.0, 0)

    def full(self, *arguments):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("pathlib.Path.open", full)
        with pytest.raises(OSError, match="No space left"):
            study.trials  # noqa: B018 - reads
    study.tell(trial, 1.0)
    (found,) = optuna.load_study(study_name="s", storage=open_storage(path)).trials
    assert found.intermediate_values == {} and found.value == 1.0


def test_a_trial_that_another_process_has_ended_is_an_error_once(path):
    study = optuna.create_study(study_name="s", storage=open_storage(path))

    def ended_elsewhere(trial):
        for step in range(3):
            trial.report(0.0, step)
        optuna.load_study(study_name="s", storage=open_storage(path)).tell(0, state=TrialState.FAIL)
        trial.should_prune()

    refused("Cannot tell a FAIL trial", study.optimize, ended_elsewhere, n_trials=1)
    assert [trial.state for trial in study.trials] == [TrialState.FAIL]


def test_a_copy_of_a_study_does_not_write_what_waits_for_the_first(path):
    study = optuna.create_study(study_name="s", storage=open_storage(path))
    trial = study.ask()
    trial.report(3.0, 0)
    copied = pickle.loads(pickle.dumps(study))
    assert len(copied.trials) == 1
    study.tell(trial, 1.0)
    assert Path(path).read_text().count("intermediate_value") == 1
    assert copied.trials == study.trials


@pytest.mark.slow
def test_a_study_in_a_database_can_be_copied(tmp_path):
    study = optuna.create_study(storage=open_storage(f"sqlite:///{tmp_path}/studies.db"))
    study.add_trial(optuna.trial.create_trial(value=1.0))
    assert len(pickle.loads(pickle.dumps(study)).trials) == 1


@pytest.mark.parametrize("distribution", ["[" * 100_000, 7, '{"name": 3}'])
def test_a_journal_of_nonsense_is_refused_in_one_line(path, distribution):
    study = optuna.create_study(storage=open_storage(path))
    study.tell(study.ask({"Q11": optuna.distributions.FloatDistribution(0.0, 1.0)}), 1.0)
    lines = [json.loads(line) for line in Path(path).read_text().splitlines()]
    for line in lines:
        if "distribution" in line:
            line["distribution"] = distribution
    Path(path).write_text("".join(json.dumps(line) + "\n" for line in lines))
    refused("storage must be a journal file that can be written, but got", open_storage, path)


PLAN = Plan("ekf", (find_scenario("mismatch"),), prune=False)


@contextmanager
def room_for(size):
    """Within this context no file of this process grows beyond a size in bytes."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, handler)


def whole_lines(path):
    content = path.read_bytes()
    return content.endswith(b"\n") and [json.loads(line) for line in content.splitlines()]


@pytest.fixture(scope="module")
def data():
    return PLAN.training_data()


@pytest.mark.parametrize("more", [0, 1, 150, 333, 600])
def test_a_study_on_a_full_disk_keeps_what_is_finished_and_others_go_on(tmp_path, data, more):
    path = tmp_path / "j"
    other = open_study("s", PLAN, open_storage(str(path)))
    study = open_study("s", PLAN, open_storage(str(path)))
    run_trials(study, PLAN, data, 2)
    with room_for(path.stat().st_size + more), pytest.raises(OSError) as error:
        run_trials(study, PLAN, data, 4)
    assert error.value.errno == errno.EFBIG and error.value.filename == str(path)
    assert whole_lines(path)
    run_trials(other, PLAN, data, 3)  # in a process that had no part in it
    assert finished_trials(other) == 3
    assert whole_lines(path)
    resumed = open_study("s", PLAN, open_storage(str(path)))
    assert finished_trials(resumed) == 3 and len(resumed.get_trials(states=(TrialState.COMPLETE,))) == 3


@pytest.mark.slow
def test_a_worker_says_in_a_line_that_the_disk_is_full(tmp_path, data):
    path = tmp_path / "j"
    study = open_study("s", PLAN, open_storage(str(path)))
    orders = {"study": "s", "storage": str(path), "trials": 3, "workers": 1, "worker": 0, "place": 5}
    orders |= orders_of(PLAN)
    with room_for(path.stat().st_size + 10):
        done = subprocess.run(
            [sys.executable, "-m", "tuning.search.workers"],
            input=json.dumps(orders) + "\n",
            capture_output=True,
            text=True,
            restore_signals=False,  # Python ignores SIGXFSZ
        )
    assert done.returncode == 1 and len(study.trials) == 1
    *warned, said = done.stderr.splitlines()  # a first run warns that machine code is not kept either
    assert said == f"thruster: worker 0: [Errno 27] File too large: '{path}'"
    assert not any("Traceback" in line for line in warned)
