"""Relations among the numbers of a model: what is tied follows, what is held stays, and gradients know it."""

import numpy as np
import pytest

from tests.tuning.methods.problems import linear, task_of
from tuning.likelihood.gradient import goal_of, tune_by_gradient
from tuning.methods.task import find_method
from tuning.plants.thruster import find_scenario
from tuning.search.parameters import model_parameters, relation_of
from tuning.search.plan import LIKELIHOOD, LOG_SCORE, Plan
from tuning.search.space import parameters_of
from tuning.search.storage import open_storage
from tuning.search.study import open_study, run_study
from tuning.search.workers import run_in_workers

TIED = ("Q22 = 4 Q11", "R22 = 0.1", "Q11 = 1e-3..10")


@pytest.mark.parametrize(
    "text, found",
    [
        ("Q22 = 4 Q11", ("Q22", "Q11", 4.0, None, None)),
        ("Q22=2.5e-1*Q11", ("Q22", "Q11", 0.25, None, None)),
        ("Q33 = Q11", ("Q33", "Q11", 1.0, None, None)),
        ("R = .01", ("R", None, 1.0, 0.01, None)),
        (" Q11 = 1e-6 .. 1e-2 ", ("Q11", None, 1.0, None, (1e-6, 1e-2))),
        ("correlation_12 = -0.3", ("correlation_12", None, 1.0, -0.3, None)),
    ],
)
def test_forms(text, found):
    assert relation_of(text) == found


@pytest.mark.parametrize("objective", [LIKELIHOOD, LOG_SCORE])
def test_a_number_that_others_follow_has_the_sum_of_their_slopes(objective):
    problem = linear(runs=3)
    data = problem.data(range(3))
    tied = goal_of("kf", problem, data, objective, {"where": TIED})
    free = goal_of("kf", problem, data, objective)
    assert tied.coordinates.names == ("Q11", "R11") and free.coordinates.names == ("Q11", "Q22", "R11", "R22")
    some, others = tied(np.log([0.07, 0.5])), free(np.log([0.07, 0.28, 0.5, 0.1]))
    np.testing.assert_allclose(some.part_values, others.part_values, rtol=1e-12)
    by_q1, by_q2, by_r1, _ = others.scores.T
    np.testing.assert_allclose(some.scores.T, [by_q1 + by_q2, by_r1], rtol=1e-9)


def test_correlations_follow_too():
    problem = linear(runs=3)
    data, where = problem.data(range(3)), ("R_correlation_12 = -0.5 correlation_12",)
    goal = goal_of("kf", problem, data, LIKELIHOOD, {"full_q": True, "full_r": True, "where": where})
    point = goal.coordinates.of([0.05, 0.2, 0.3, 0.4, 0.1])
    model = goal.choice_at(point).model
    assert model["measurement_noise_cov"][0][1] == pytest.approx(-0.15 * np.sqrt(0.4 * 0.1))
    step = 1e-5 * np.eye(5)
    sides = [[goal(point + sign * one).value for one in step] for sign in (1, -1)]
    np.testing.assert_allclose(goal(point).gradient, (np.array(sides[0]) - sides[1]) / 2e-5, rtol=1e-6, atol=1e-5)


def test_gradients_end_where_the_relation_is_true_of_the_plant():
    problem = linear(runs=30, steps=100)
    found = tune_by_gradient("kf", problem, problem.data(range(30)), options={"where": TIED})
    assert found.agree and [one.name for one in found.free] == ["Q11", "R11"]
    assert found.choice.model["measurement_noise_cov"][1] == 0.1
    q = found.choice.model["process_noise_cov"]
    assert q[1] == pytest.approx(4 * q[0]) and q[0] == pytest.approx(0.05, rel=0.1)


@pytest.mark.parametrize("method", ["likelihood", "nelder-mead", "random-only", "posterior"])
def test_methods_keep_them(method):
    task = task_of(linear(), options={"where": TIED})
    task.budget = task.budget._replace(runs=2000)
    find_method(method).run(method, task)
    assert len(task.answers) > 1
    for one in task.answers[1:]:
        q, r = one.choice.model["process_noise_cov"], one.choice.model["measurement_noise_cov"]
        assert q[1] == pytest.approx(4 * q[0], rel=1e-12) and r[1] == 0.1


def test_a_method_that_finds_whole_matrices_knows_none():
    task = task_of(linear(), options={"where": TIED})
    with pytest.raises(ValueError, match="method 'em' must come without where"):
        find_method("em").run("em", task)


@pytest.mark.slow
def test_a_study_and_its_workers_keep_them_and_resume(tmp_path):
    plan = Plan("ekf", (find_scenario("mismatch"),), where=("Q22 = 1e-3 Q11", "R = 0.5..50"))
    path = str(tmp_path / "j")
    study = open_study("s", plan, open_storage(path))
    run_in_workers(study, plan, plan.training_data(), 12, lambda *_: None, storage=path, workers=2)
    result = run_study(open_study("s", plan, open_storage(path)), plan, 16)
    assert {name for one in result.trials for name in one.params} == {"Q11", "R"}
    for found in (result.choice, *(one.choice for one in result.validation.met)):
        one = parameters_of(found)
        assert one["Q22"] == pytest.approx(1e-3 * one["Q11"], rel=1e-12) and 0.5 <= one["R"] <= 50
    with pytest.raises(ValueError, match="study 's' must be for .*where"):
        open_study("s", plan._replace(where=()), open_storage(path))


@pytest.mark.parametrize(
    "where, rule",
    [
        (("Q22 : 4",), r"a relation must be NAME = \[FACTOR\] NAME, .* but got 'Q22 : 4'"),
        (("Q22 = 4 Q99",), "relations must be among Q11, Q22, R11, R22,.* but got 'Q22 = 4 Q99'"),
        (("Q22 = Q11", "Q22 = 1"), "at most one relation, but Q22 has more"),
        (("Q22 = Q11", "R11 = Q22"), "in proportion to one that is free, but got 'R11 = Q22'"),
        (("Q22 = Q22",), "in proportion to one that is free, but got 'Q22 = Q22'"),
        (("Q22 = -1",), "Q22 must be positive, but got 'Q22 = -1'"),
        (("Q22 = -2 Q11",), "a variance must be a positive multiple, but got 'Q22 = -2 Q11'"),
        (("Q22 = 2..1",), "a range must be LOW..HIGH with LOW below HIGH, but got 'Q22 = 2..1'"),
        (("Q11 = 1", "Q22 = 1", "R11 = 1", "R22 = 1"), "must leave a parameter to tune, but got Q11 = 1, Q22 = 1"),
    ],
)
def test_relations_that_cannot_be(where, rule):
    with pytest.raises(ValueError, match=rule):
        model_parameters(linear(), where=where)
    with pytest.raises(ValueError, match=rule):
        Plan("kf", (linear(),), where=(*where, *["P0 = 1"] * ("R22 = 1" in where))).checked()


def test_a_filter_without_a_covariance_has_no_numbers_to_relate():
    with pytest.raises(ValueError, match="relations need a filter with a covariance, but got 'low-pass'"):
        Plan("low-pass", (find_scenario("nominal"),), where=("Q11 = 1",)).checked()
