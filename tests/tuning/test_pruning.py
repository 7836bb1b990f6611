"""Pruning ranks single runs, the objective pools their squares: studies with it and without end alike."""

import numpy as np
import pytest
from scipy import stats

from docs.scripts.tuning_choice import TOP_RUNS, over_studies, pruning_pair
from tuning.search.plan import TRAINING_SEEDS
from tuning.search.storage import quiet_optuna


@pytest.mark.slow
def test_with_pruning_a_study_ends_at_the_score_that_it_has_without():
    quiet_optuna()
    found = pruning_pair(
        "ekf", "startup", 16, seed=2
    )  # so short a study may end elsewhere by its other trials, too: seed 1
    assert found.pruned >= 2 and found.skipped > 0.05
    assert found.concentration > 2 * TOP_RUNS / TRAINING_SEEDS  # few runs do carry the error
    assert found.gain > 0.995  # no pruned trial, run to its end, would have been better by more
    assert found.ratio == pytest.approx(1.0, abs=0.02)


def test_the_interval_over_studies_is_student_s():
    ratios = [0.99, 1.01, 1.0, 1.02]
    found, logs = over_studies(ratios), np.log(ratios)
    expected = stats.t.interval(0.95, 3, loc=logs.mean(), scale=stats.sem(logs))
    assert np.log([found.low, found.high]) == pytest.approx(expected)
    assert found.value == pytest.approx(stats.gmean(ratios))
