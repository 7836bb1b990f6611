"""Which trial of a study is chosen, and what is said where none is consistent."""

import json
import re
import sys

import optuna
import pytest

from filters.consistency.nees import Interval
from tuning.cli.main import main
from tuning.evaluation.baselines import SCALED
from tuning.evaluation.sizes import SizeRow, sufficient_size
from tuning.search.among_types import BASELINE
from tuning.search.objectives import NIS_BAND
from tuning.search.plan import Plan
from tuning.search.storage import open_storage
from tuning.search.study import BEST, open_study, run_study
from tuning.search.trials import CONSISTENCY, best_trial, is_consistent
from tuning.thruster.scenario import find_scenario

PLAN = Plan("ekf", (find_scenario("mismatch"),))  # whose untuned filter has a mean NIS of 0.2


@pytest.fixture
def thruster(monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("tuning.evaluation.held_out.HELD_OUT_SEEDS", 8)

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["thruster", *map(str, arguments)])
        with pytest.raises(SystemExit) as stop:
            main()
        return stop.value.code, " ".join(capsys.readouterr().out.split())

    return run


def trial(value, outside=None):
    constraints = {} if outside is None else {CONSISTENCY: outside}
    return optuna.trial.create_trial(values=[value], constraints=constraints)


@pytest.mark.parametrize(
    ("trials", "best"),
    [
        ([(40.0, 0.5), (1.0, 0.7)], 1.0),  # none is consistent: the score decides
        ([(40.0, 0.0), (1.0, 0.7)], 40.0),
        ([(40.0, -0.1), (30.0, -0.01), (1.0, 1e-9)], 30.0),
        ([(2.0, None), (1.0, None)], 1.0),
    ],
)
def test_the_best_trial_has_the_least_error_of_the_consistent_ones_else_of_all(trials, best):
    assert best_trial([trial(*each) for each in trials]).value == best
    assert best_trial([]) is None


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_a_study_without_a_consistent_trial_says_so_everywhere(thruster, tmp_path):
    code, said = thruster("tune", "--filter", "ekf", "--trials", 1, "--json", "one.json")
    assert code == 3 and "in its band" not in said
    assert "No trial was consistent: a mean NIS must lie between 0.8 and 1.25, where 1 is right, but" in said
    data = json.loads((tmp_path / "one.json").read_text())
    study = json.loads((tmp_path / "out" / "ekf-mismatch-seed0.json").read_text())["study"]
    for found in (data, study):
        assert found["any_trial_consistent"] is False and found["nis_band"] == list(NIS_BAND)
        (nis,) = found["mean_nis"]
        assert 0.1 < nis < 0.5
    assert f"but the tuned filter's is {nis:.3g} on the training seeds" in said
    assert study["consistent"] is True, "what was asked for"
    thruster("report", "out/ekf-mismatch-seed0.json")
    page = (tmp_path / "out" / "ekf-mismatch-seed0.html").read_text()
    assert f"to lie between 0.8 and 1.25, where 1 is right; it is {nis:.3g}, outside" in page
    code, said = thruster("tune", "--filter", "ekf", "--trials", 40, "--json", "two.json")
    data = json.loads((tmp_path / "two.json").read_text())
    assert not code and data["any_trial_consistent"] is True and re.search(r"returns trial \d+ rescaled: ", said)
    assert (
        "Consistent jointly, but not in each state: mean NEES 2." in said
    )  # by the log score, as no Q and R make NIS and NEES right here
    code, _ = thruster("tune", "--filter", "ekf", "--trials", 1, "--no-consistency", "--json", "free.json")
    data = json.loads((tmp_path / "free.json").read_text())
    assert not code and data["any_trial_consistent"] is None and data["mean_nis"] == []


def test_a_smaller_ensemble_of_a_consistent_trial_is_consistent_too():
    found = (5, 1.0, 0.2), (10, 1.3, -0.1), (20, 1.0, -0.1)
    rows = [SizeRow(n, None, Interval(ratio, ratio, ratio), outside) for n, ratio, outside in found]
    assert sufficient_size(rows) == 5 and sufficient_size(rows, consistent=True) == 20
    assert sufficient_size(rows[:1], consistent=True) == 5


def test_a_study_names_its_best_trial_to_programs_that_know_no_constraints(tmp_path):
    storage = open_storage(str(tmp_path / "j"))
    run_study(open_study("s", PLAN, storage), PLAN, 4)
    study = optuna.load_study(study_name="s", storage=storage)
    best = best_trial(study.trials)
    assert study.user_attrs[BEST] == best.number == study.best_trial.number
    assert is_consistent(best) and best.user_attrs[BASELINE] == SCALED
    study.set_user_attr(BEST, 0)  # what a slower worker wrote last
    run_study(open_study("s", PLAN, storage), PLAN, 4)
    assert study.user_attrs[BEST] == best.number
