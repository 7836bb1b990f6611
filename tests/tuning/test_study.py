import json
import os
import signal
import subprocess
import sys

import optuna
import pytest
from optuna.trial import TrialState

from filters.tuned_file import sealed
from tests.filters.checks import refused
from tuning.evaluation.held_out import evaluate_held_out
from tuning.evaluation.tuned import read_tuned, write_tuned
from tuning.plants.thruster import find_scenario
from tuning.search.plan import Plan
from tuning.search.space import parameters_of, untuned_choice
from tuning.search.storage import PROCESS, RETRY_OF, open_storage
from tuning.search.study import finished_trials, open_study, run_study

SCENARIO = find_scenario("mismatch")
PLAN = Plan("ekf", (SCENARIO,))


def study_in(storage, name="s", seed=0):
    return open_study(name, PLAN._replace(seed=seed), storage)


def test_a_study_starts_untuned_never_sees_the_truth_and_improves_on_held_out_seeds(tmp_path):
    study = study_in(open_storage(str(tmp_path / "j")))
    seen = []
    result = run_study(study, PLAN, 25, lambda study, finished: seen.append(finished))
    assert seen == list(range(1, 26))
    first = result.trials[0].params
    assert first == pytest.approx(dict(parameters_of(untuned_choice("ekf", SCENARIO))))
    true = SCENARIO.true["process_noise_cov"]
    assert all((t.params["Q11"], t.params["Q22"]) != true for t in result.trials)
    comparison = evaluate_held_out(result.choice, SCENARIO, 0, 100)
    assert comparison.tuned.score.high < comparison.untuned.score.low
    assert result.best_value < result.trials[0].value

    path = tmp_path / "tuned.json"
    write_tuned(path, PLAN, result, [comparison], "s")
    assert read_tuned(path) == (result.choice, SCENARIO, 0)
    stored = json.loads(path.read_text())["held_out"]["mismatch"]["tuned"]
    assert stored["rmse"][0] == list(comparison.tuned.rmse[0])


def test_the_same_seed_gives_the_same_study_and_another_seed_another():
    def values(seed):
        study = study_in(optuna.storages.InMemoryStorage(), seed=seed)
        return [t.params for t in run_study(study, PLAN._replace(seed=seed), 12).trials]

    assert values(0) == values(0)
    assert values(0)[1:] != values(1)[1:]


def test_a_resumed_study_counts_what_is_there_and_does_not_repeat_it(tmp_path):
    path = str(tmp_path / "j")
    run_study(study_in(open_storage(path)), PLAN, 5)
    resumed = run_study(study_in(open_storage(path)), PLAN, 9)
    assert len(resumed.trials) == 9
    points = [tuple(t.params.values()) for t in resumed.trials]
    assert len(set(points)) == 9


def test_a_study_for_something_else_is_refused(tmp_path):
    storage = open_storage(str(tmp_path / "j"))
    study_in(storage)
    refused("study 's' must be for .*'seed': 3.* but it was made for .*'seed': 0", study_in, storage, seed=3)


def interrupt_at_once():
    raise KeyboardInterrupt


def interrupt_by_a_signal():
    """After which the running trial may finish."""
    os.kill(os.getpid(), signal.SIGINT)


@pytest.mark.parametrize("interrupt", [interrupt_at_once, interrupt_by_a_signal])
def test_ctrl_c_keeps_finished_trials(tmp_path, interrupt):
    study, handler = study_in(open_storage(str(tmp_path / "j"))), signal.getsignal(signal.SIGINT)
    result = run_study(study, PLAN, 50, lambda study, finished: interrupt() if finished == 4 else None)
    assert result.interrupted and finished_trials(study) == 4
    assert not [t for t in study.trials if t.state == TrialState.RUNNING]
    assert signal.getsignal(signal.SIGINT) is handler


def test_a_trial_of_a_dead_process_is_failed_and_tried_once_more(tmp_path):
    storage = open_storage(str(tmp_path / "j"))
    study = study_in(storage)
    trial = study.ask()
    trial.suggest_float("Q11", 1.0, 1e4)
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    trial.set_user_attr(PROCESS, f"{os.uname().nodename}:{dead.pid}")
    again = study_in(storage)
    states = [t.state for t in again.trials]
    assert states == [TrialState.FAIL, TrialState.WAITING]
    assert again.trials[1].user_attrs[RETRY_OF] == 0
    assert [t.state for t in study_in(storage).trials] == states  # once only


def test_a_running_trial_of_a_living_process_is_left_alone(tmp_path):
    storage = open_storage(str(tmp_path / "j"))
    trial = study_in(storage).ask()
    trial.set_user_attr(PROCESS, f"{os.uname().nodename}:{os.getpid()}")
    assert study_in(storage).trials[0].state == TrialState.RUNNING


def test_a_torn_last_line_is_cut_off_and_the_study_goes_on(tmp_path):
    path = tmp_path / "j"
    run_study(study_in(open_storage(str(path))), PLAN, 3)
    with path.open("a") as stream:
        stream.write('{"op_code": 5, "worker_id": "x", "tri')
    with pytest.warns(UserWarning, match="cut off its last line"):
        storage = open_storage(str(path))
    assert len(run_study(study_in(storage), PLAN, 5).trials) == 5


@pytest.mark.parametrize("bytes_left", [1, 5, 28])
def test_a_torn_first_line_is_cut_off(tmp_path, bytes_left):
    path = tmp_path / "j"
    study_in(open_storage(str(path)))
    path.write_bytes(path.read_bytes()[:bytes_left])
    with pytest.warns(UserWarning, match="cut off its last line"):
        storage = open_storage(str(path))
    assert len(run_study(study_in(storage), PLAN, 2).trials) == 2


@pytest.mark.parametrize(
    ("content", "rule"),
    [(b"hello\n", "journal"), (b"hello", "journal"), (b'{"op_code": 0}\nx\n{"op_code": 1}\n', "line 2")],
)
def test_a_file_that_is_no_journal_is_refused_and_left_as_it_is(tmp_path, content, rule):
    path = tmp_path / "notes.txt"
    path.write_bytes(content)
    refused(f"storage must be a journal file.*{rule}", open_storage, str(path))
    assert path.read_bytes() == content


@pytest.mark.parametrize(
    ("change", "rule"),
    [
        ({"parameter_factors": {"voltage_gain": 3.0}}, "must be that of its scenario"),
        ({"preset": "rubbish"}, "an argument of the model of a tuned file must be one of"),
        ({"measurement_noise_cov": None}, "must have a measurement_noise_cov"),
        ({"process_noise_cov": [1.0]}, "process_noise_cov must be 2 variances or a symmetric 2 x 2 matrix"),
    ],
)
def test_a_tuned_file_edited_by_hand_is_refused(tmp_path, change, rule):
    result = run_study(study_in(optuna.storages.InMemoryStorage()), PLAN, 2)
    path = tmp_path / "tuned.json"
    write_tuned(path, PLAN, result, [evaluate_held_out(result.choice, SCENARIO, 0, 2)], "s")
    content = json.loads(path.read_text())
    content["filter"]["model"].update(change)
    path.write_text(json.dumps(content))
    refused("a tuned file must be unchanged", read_tuned, path)
    path.write_text(json.dumps(sealed(content)))
    refused(rule, read_tuned, path)
