"""Pruning decides as Optuna's test does, by a sum of ranks."""

import warnings

import numpy as np
import optuna
import pytest
from scipy import stats

from tuning.search.study import P_THRESHOLD, PairedPruner, critical_rank_sum, positive_rank_sum
from tuning.search.trials import BLOCK


def pruner_of_optuna():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        return optuna.pruners.WilcoxonPruner(p_threshold=P_THRESHOLD, n_startup_steps=BLOCK)


def trial_of(values, state, value=None):
    return optuna.trial.create_trial(state=state, value=value, intermediate_values=dict(enumerate(values)))


def decisions(best, own):
    """Of our pruner and of Optuna's, with a better but infeasible trial in the study."""
    study = optuna.create_study()
    if best is not None:
        study.add_trial(trial_of(best, optuna.trial.TrialState.COMPLETE, 1.0))
    trial = trial_of(own, optuna.trial.TrialState.RUNNING)
    return PairedPruner().prune(study, trial), pruner_of_optuna().prune(study, trial)


@pytest.mark.parametrize("count", [8, 16, 24, 5])
def test_the_critical_sum_of_ranks_is_that_of_scipys_test(count):
    rng = np.random.default_rng(count)
    for shift in np.linspace(-0.2, 1.0, 40):
        differences = rng.normal(shift, 1.0, count)
        p = stats.wilcoxon(differences, alternative="greater", zero_method="zsplit").pvalue
        assert (positive_rank_sum(differences.tolist()) >= critical_rank_sum(count, P_THRESHOLD)) == (
            p < P_THRESHOLD
        )


def test_it_decides_as_optunas_pruner():
    rng, found = np.random.default_rng(0), []
    for _ in range(60):
        best = rng.gamma(2.0, size=32)
        own = best[: 8 * rng.integers(1, 4)] + rng.normal(0.3, 1.0, 1) * rng.gamma(2.0, size=1)
        own = own + rng.normal(0.0, 0.8, len(own))
        mine, optunas = decisions(best, own)
        assert mine == optunas
        found.append(mine)
    assert 10 < sum(found) < 50


@pytest.mark.filterwarnings("ignore:.*WilcoxonPruner")
@pytest.mark.parametrize(
    ("best", "own"),
    [
        (None, [2.0] * 8),
        (np.arange(32.0), np.arange(8.0)),  # no difference
        (np.arange(32.0), np.arange(8.0) + 20.0),  # equal ones
        (np.zeros(32), [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, np.inf]),
        (np.append(np.zeros(31), np.nan), np.arange(1.0, 9.0)),
        (np.zeros(4), np.arange(1.0, 9.0)),  # more seeds than the best trial has
        (np.zeros(32), []),
        (np.zeros(32), np.arange(1.0, 7.0)),  # fewer than a block
        ([], np.arange(1.0, 9.0)),
        (np.zeros(60), np.arange(1.0, 58.0)),
    ],
)
def test_it_leaves_the_rare_cases_to_optuna(best, own):
    mine, optunas = decisions(best, own)
    assert mine == optunas


def test_the_best_trial_is_a_feasible_one():
    study = optuna.create_study()

    def objective(trial):
        trial.set_constraint("band", 1.0 if trial.number == 0 else -1.0)
        for step in range(32):
            trial.report(float(trial.number + 0.01 * step), step)
        return float(trial.number)

    study.optimize(objective, n_trials=2)
    trial = trial_of(
        np.linspace(0.5, 0.6, 8), optuna.trial.TrialState.RUNNING
    )  # worse than trial 0, better than 1
    assert not PairedPruner().prune(study, trial)
    assert not pruner_of_optuna().prune(study, trial)
