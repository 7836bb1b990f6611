"""Pruning ranks single runs, the objective pools their squares: studies with it and without end alike."""

import numpy as np
import pytest
from optuna.trial import TrialState

from tuning.evaluation.evaluate import evaluate, score_ratio
from tuning.experiments.benchmark import run_in_memory
from tuning.plants.thruster import find_scenario
from tuning.search.plan import TRAINING_SEEDS, Plan
from tuning.search.space import choice_of
from tuning.search.trials import measure


@pytest.mark.slow
def test_with_pruning_a_study_ends_at_the_score_that_it_has_without():
    """So short a study may end elsewhere by its other trials, too: with seed 1."""
    scenario = find_scenario("startup")
    plans = [Plan("ekf", (scenario,), 2, prune=prune) for prune in (True, False)]
    pruned, whole = (run_in_memory(plan, 16) for plan in plans)
    training, held_out = plans[1].training_data(), scenario.data(scenario.held_out_seeds(2, 200))
    early = [trial for trial in pruned.trials if trial.state == TrialState.PRUNED and trial.intermediate_values]
    assert len(early) >= 2
    assert sum(TRAINING_SEEDS - len(trial.intermediate_values) for trial in early) > 0.05 * TRAINING_SEEDS * 16
    (chosen,) = measure(pruned.choice, plans[1], training)
    worst = np.sort(chosen.mean_squares, axis=0)[-3:].sum(axis=0) / chosen.mean_squares.sum(axis=0)
    assert worst.max() > 2 * 3 / TRAINING_SEEDS  # few runs do carry the error
    for trial in early:  # none, run to its end, would have been better by more
        (full,) = measure(choice_of("ekf", trial.params, scenario), plans[1], training)
        assert full.score.value > 0.995 * pruned.best_value
    by = [evaluate(result.choice.filter(scenario), held_out, scenario.scale) for result in (pruned, whole)]
    assert score_ratio(*by).value == pytest.approx(1.0, abs=0.02)
