"""Gradients of objectives on the true states: their minimum is a study's objective, and lower than others."""

import numpy as np
import pytest

from tests.linear_problem import LinearProblem
from tests.slow import slow_but
from tuning.evaluation.evaluate import evaluate
from tuning.likelihood.gradient import tune_by_gradient
from tuning.search.among_types import BY_GRADIENT, MAXIMUM_LIKELIHOOD_AFTER
from tuning.search.objectives import OBJECTIVES
from tuning.search.plan import Plan
from tuning.search.space import choice_of
from tuning.search.study import open_study, run_study
from tuning.thruster.scenario import find_scenario

MISMATCH = find_scenario("mismatch")


def value_of(objective, choice, problem, data):
    found = evaluate(choice.filter(problem), data, problem.scale)
    return OBJECTIVES[objective].value(found, np.nan)


@pytest.mark.parametrize("objective", slow_but(["score", "mse", "log-score"], ["mse"]))
def test_the_minimum_is_the_objectives_and_lower_than_other_ways_lead(objective):
    data = MISMATCH.data(range(40))
    found = tune_by_gradient("ekf", MISMATCH, data, objective=objective)
    least = value_of(objective, found.choice, MISMATCH, data)
    assert found.best.level == pytest.approx(least, rel=1e-9)
    others = tune_by_gradient("ekf", MISMATCH, data, [1.0]).choice
    assert least < value_of(objective, others, MISMATCH, data)
    for name in found.names:  # a step either way is worse, unless the data do not tell
        at = found.names.index(name)
        for factor in (0.7, 1.4):
            moved = found.best.parameters.copy()
            moved[at] *= factor
            model = dict(found.choice.model) | {
                "process_noise_cov": tuple(moved[:2]),
                "measurement_noise_cov": tuple(moved[2:]),
            }
            assert least <= value_of(objective, found.choice._replace(model=model), MISMATCH, data) * (1 + 1e-9)


def test_a_study_of_an_objective_that_has_a_gradient_tries_where_it_leads_and_finds_nothing_much_better():
    plan = Plan("ekf", (MISMATCH,), objectives=("log-score",), consistent=False)
    result = run_study(open_study("gradient", plan), plan, MAXIMUM_LIKELIHOOD_AFTER + 2)
    (tried,) = [trial for trial in result.trials if BY_GRADIENT in trial.user_attrs]
    assert 0 < tried.number < 6 and tried.user_attrs[BY_GRADIENT] == "log-score"
    found = tune_by_gradient("ekf", MISMATCH, plan.training_data()[0], [1.0], "log-score")
    assert [tried.params[name] for name in found.names] == pytest.approx(found.best.parameters)
    assert result.best_value == pytest.approx(found.best.level, rel=1e-6)


def test_objectives_on_true_states_need_them():
    data = MISMATCH.data(range(2))
    with pytest.raises(ValueError, match="must be 'likelihood' without true states, but got 'mse'"):
        tune_by_gradient("ekf", MISMATCH, data._replace(states=None), objective="mse")
    with pytest.raises(
        ValueError, match="objective must be one of likelihood, score, mse, log-score, but got 'nees'"
    ):
        tune_by_gradient("ekf", MISMATCH, data, objective="nees")


@pytest.mark.slow
def test_a_study_of_the_score_follows_its_gradient_only_where_there_are_many_numbers():
    plan = Plan("kf", (LinearProblem(n=3),), full_q=True, full_r=True)
    result = run_study(open_study("many", plan), plan, 8)
    (tried,) = [trial for trial in result.trials if BY_GRADIENT in trial.user_attrs]
    best = tune_by_gradient("kf", plan.scenarios, plan.training_data(), [1.0], "score", plan.options).best
    assert tried.user_attrs[BY_GRADIENT] == "score" and len(best.parameters) == 9
    values = [trial.values[0] for trial in result.trials if trial.values]
    assert best.level <= min(values) * (1 + 1e-4)
    choice = choice_of("kf", tried.params, plan.scenarios[0])
    (data,) = plan.training_data()
    assert value_of("score", choice, plan.scenarios[0], data) == pytest.approx(best.level, rel=1e-4)
    few = plan._replace(full_q=False, full_r=False)
    result = run_study(open_study("few", few), few, 8)
    assert not any(BY_GRADIENT in trial.user_attrs for trial in result.trials)
