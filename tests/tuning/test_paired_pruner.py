"""Which trials go on, as Optuna's test decides by a sum of ranks, and which one is chosen at the end."""

import warnings

import numpy as np
import optuna
import pytest
from optuna.trial import TrialState
from scipy import stats

from tuning.evaluation.baselines import SCALED
from tuning.evaluation.evaluate import evaluate, score_ratio
from tuning.experiments.benchmark import run_in_memory
from tuning.plants.thruster import find_scenario
from tuning.search.among_types import BASELINE
from tuning.search.plan import TRAINING_SEEDS, Plan
from tuning.search.space import choice_of
from tuning.search.storage import open_storage
from tuning.search.study import (
    BEST,
    P_THRESHOLD,
    PairedPruner,
    critical_rank_sum,
    open_study,
    positive_rank_sum,
    run_study,
)
from tuning.search.trials import BLOCK, CONSISTENCY, best_trial, is_consistent, measure


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
        is_critical = positive_rank_sum(differences.tolist()) >= critical_rank_sum(count, P_THRESHOLD)
        assert is_critical == (p < P_THRESHOLD)


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
    trial = trial_of(np.linspace(0.5, 0.6, 8), TrialState.RUNNING)  # worse than trial 0, better than 1
    assert not PairedPruner().prune(study, trial)
    assert not pruner_of_optuna().prune(study, trial)


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
