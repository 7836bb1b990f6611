"""Which trial of a study is chosen, and what is said where none is consistent."""

import optuna
import pytest

from tuning.evaluation.baselines import SCALED
from tuning.plants.thruster import find_scenario
from tuning.search.among_types import BASELINE
from tuning.search.plan import Plan
from tuning.search.storage import open_storage
from tuning.search.study import BEST, open_study, run_study
from tuning.search.trials import CONSISTENCY, best_trial, is_consistent

PLAN = Plan("ekf", (find_scenario("mismatch"),))  # whose untuned filter has a mean NIS of 0.2


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
