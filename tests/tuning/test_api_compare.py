"""`tuning.compare`: the rows of the command, as a value; and filters that are tuned first."""

import copy
import pickle
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import tuning
from tests import pendulum_problem
from tests.filters.checks import refused
from tests.linear_problem import LinearProblem
from tests.models import wide_model
from tests.small_problems import UNITS, pair
from tests.tuning.methods.problems import linear, task_of
from tests.tuning.test_api_study import plain
from thruster_env.model.affine import affine_model
from tuning.api.compare import default_filters
from tuning.evaluation.compare import known
from tuning.evaluation.evaluate import evaluate, score_ratio
from tuning.evaluation.residuals import model_error
from tuning.likelihood.gradient import goal_of, tune_by_gradient
from tuning.methods.task import find_method
from tuning.plants.thruster import find_scenario
from tuning.problems.excitation import Steps
from tuning.problems.find import find_problem
from tuning.problems.model_problem import ModelProblem
from tuning.reporting.tables import as_json as boards_as_json
from tuning.search.parameters import model_parameters, relation_of
from tuning.search.plan import LIKELIHOOD, LOG_SCORE, Plan
from tuning.search.space import given_choice, parameters_of
from tuning.search.storage import open_storage
from tuning.search.study import open_study, run_study
from tuning.search.workers import run_in_workers

SHORT = find_problem("nominal").replace(steps=70, name="short")


def without_time(boards):
    """Boards as plain data, without what the clock says."""
    for board in boards["scenarios"].values():
        for row in board["filters"].values():
            del row["microseconds_a_step"]
    return boards


@pytest.fixture(scope="module")
def comparison():
    return tuning.compare(["kf", "ekf"], SHORT, seeds=6, progress=False)


def test_compare_is_the_command_in_one_call(as_json):
    told = as_json(
        *("compare", "--filter", "ekf", "--filter", "enkf", "--problem", "nominal", "--seeds", 3, "--seed", 2),
        *("--ensemble-size", "enkf=7", "--augment", "ambient_velocity:0.3"),
    )
    unknown = {"ambient_velocity": 0.3}
    found = tuning.compare(["ekf", "enkf"], seeds=3, seed=2, ensemble_size={"enkf": 7}, augment=unknown)
    ours = plain(boards_as_json(list(found.boards)))
    assert without_time(ours) == without_time({key: told[key] for key in ours}) and told["seed"] == found.seed
    assert found.filters == ("ekf", "ekf + U_0", "enkf 7", "enkf 7 + U_0")


def test_a_comparison_shows_itself(comparison):
    assert repr(comparison).startswith("FilterComparison(short: ekf ") and comparison.ranked() == ["ekf", "kf"]
    assert comparison.sentences() == ["By the score on short, ekf is better than kf."]
    table = comparison.to_frame()
    rows = comparison.boards[0].rows
    assert table["filter"].tolist() == ["kf", "ekf"] and table["verdict"].tolist() == ["", rows[1].verdict]
    assert table["score over first"].tolist() == [row.score_ratio.value for row in rows]
    assert table["score"].tolist() == [row.evaluation.score.value for row in rows]
    text = comparison._repr_html_()
    assert "better" in text and "nan" not in text and text.count("<table") == 2
    for other in (copy.deepcopy(comparison), pickle.loads(pickle.dumps(comparison))):
        assert repr(other) == repr(comparison)


def test_rows_have_the_labels_of_a_mapping_and_their_numbers_from_any_executor(comparison):
    with ThreadPoolExecutor(2) as pool:
        own = tuning.compare({"mine": "kf", "theirs": "ekf"}, SHORT, seeds=6, executor=pool, progress=False)
    tables = own.to_frame(), comparison.to_frame()
    mine, theirs = (dict(zip(one["filter"], one["score"], strict=True)) for one in tables)
    assert mine == {"mine": theirs["kf"], "theirs": theirs["ekf"]}


def test_filters_are_tuned_first_where_that_is_asked_for(tmp_path):
    found = tuning.compare(["kf", "ekf"], SHORT, trials=4, seeds=4, progress=False)
    assert found.filters == ("kf", "ekf")
    plain = tuning.compare("ekf", SHORT, seeds=4, knows="untuned", progress=False).boards[0].rows[0]
    kf, ekf = found.boards[0].rows
    assert {kf.knows, ekf.knows} <= {"study", "scaled", "untuned", "noise"} and ekf.verdict == "better"
    assert ekf.evaluation.score.value < plain.evaluation.score.value and "Model and plant" not in str(found)
    study = tuning.tune(SHORT, "ekf", trials=2, progress=False)
    file = study.save(tmp_path / "mine.json")
    again = tuning.compare([study, file, study, "ekf"], seeds=4, progress=False)
    assert again.filters == ("ekf tuned", "mine", "ekf tuned 2", "ekf") and again.problems == (SHORT,)
    scores = [row.evaluation.score.value for row in again.boards[0].rows]
    assert scores[0] == scores[1] == scores[2] != scores[3]


def test_where_nobody_knows_the_noise_filters_have_the_scaled_default():
    found = tuning.compare("ekf", LinearProblem(n=2, m=1, truth=False), seeds=4, progress=False)
    assert not found.boards[0].rows[0].evaluation.has_truth and "nan" not in found._repr_html_()
    assert np.isfinite(found.to_frame()["log-likelihood"]).all() and found.plot_scores().axes


def test_filters_with_what_a_model_came_with_are_those_of_the_baseline():
    problem = pair(assumed=wide_model(**UNITS).replace(process_noise_cov=[0.5, 0.5, 0.5]))
    rows = tuning.compare("kf", problem, seeds=4, knows="given", progress=False).boards[0].rows
    choice = given_choice("kf", problem)
    data = problem.data(problem.held_out_seeds(0, 4))
    assert rows[0].evaluation.score == evaluate(choice.filter(problem), data, problem.scale).score
    with pytest.raises(ValueError, match="given Q and R must be those of a user's model or .* but short has none"):
        tuning.compare("ekf", SHORT, seeds=2, knows="given")


def sluggish(**options):
    """A plant that is slower than its model; both have the same Q and R."""
    noise = {"process_noise_cov": [0.04], "measurement_noise_cov": [1.0]}
    start = {"prior_mean": [0.0], "prior_cov": [1.0], "b": np.ones((1, 1)), "c": [[1.0]], "states": ["x"], **noise}
    truth, assumed = (affine_model(a=[[a]], **start) for a in (0.98, 0.7))
    return ModelProblem(truth, assumed, Steps(hold=5), steps=20, first_scored_step=4, scale=(1.0,), **options)


def test_with_a_wrong_model_each_filter_has_the_best_q_and_r_of_a_study_and_noise_estimation():
    problem = sluggish(name="sluggish")
    assert model_error(problem).startswith("the residuals of x have ")
    found = tuning.compare("kf", problem, seeds=20, progress=False)
    oracle = tuning.compare("kf", problem, seeds=20, knows="true", progress=False)
    (row,), (other,) = found.boards[0].rows, oracle.boards[0].rows
    assert row.knows in ("study", "noise") and other.knows == "true"
    assert score_ratio(row.evaluation, other.evaluation).high < 0.9
    text = " ".join(str(found).split())
    assert "Model and plant differ: the residuals of x have" in text and "Model and plant" not in str(oracle)
    right = ModelProblem(problem.truth, inputs=problem.inputs, steps=20, first_scored_step=4, scale=(1.0,))
    assert model_error(right) == "" and known(None, "kf", right).source == "true"


def test_particles_are_left_out_by_default_where_there_are_many_states():
    found = tuning.compare(problem=LinearProblem(n=7, m=1, steps=20), seeds=2, knows="untuned", progress=False)
    assert found.filters == ("ekf", "enkf 30") and "pf is left out: by default particles" in str(found)
    assert default_filters([SHORT]) == (["ekf", "enkf", "pf"], {})


def test_a_comparison_s_study_does_not_tune_the_ensemble_size():
    assert Plan("enkf", (SHORT,)).space()["N"].single() is False
    plan = Plan("enkf", (SHORT,), ensemble_size=7)
    assert plan.space()["N"].single() and plan.choice_of({"N": 7}).numbers["ensemble_size"] == 7
    assert plan.identity != Plan("enkf", (SHORT,)).identity


WRONG = [
    (lambda: tuning.compare(["ekf", "ekf"], SHORT, seeds=2), "must be of different filters, but got ekf, ekf"),
    (lambda: tuning.compare([]), "a comparison must have at least one filter, but got none"),
    (lambda: tuning.compare(["ekf", 3]), "a tuned file, a Study or an estimator, but got 3"),
    (lambda: tuning.compare("no-filter"), "filter must be one of .*, but got 'no-filter'"),
    (lambda: tuning.compare("ekf", ensemble_size={"ekf": 5}), "be for a filter with an ensemble, but got ekf: 5"),
    (lambda: tuning.compare("enkf", ensemble_size=1), "must be a whole number of at least 2, but got 1"),
    (lambda: tuning.compare("ekf", knows="all"), "one of true, scaled, .*, noise, study, but got 'all'"),
    (lambda: tuning.compare("ekf", trials=2, knows="true"), "knows must be left out, or 'study', with trials"),
    (lambda: tuning.compare("ekf", seeds=1), "held-out seeds must be a whole number of at least 2, but got 1"),
]


@pytest.mark.parametrize("call, said", WRONG)
def test_errors_state_the_rule_and_the_value(call, said):
    refused(said, call)


def test_a_filter_that_refuses_the_model_is_left_out_and_the_others_are_compared():
    problem = pendulum_problem.problem(name="pendulum of mine")
    found = tuning.compare(["kf", "ekf", "ukf"], problem, seeds=2, progress=False)
    assert found.filters == ("ekf", "ukf") and list(found.left_out) == ["kf"]
    said = "a Kalman filter must have an affine model (filters.affine_model makes one)"
    assert f"kf is left out: {said}" in " ".join(str(found).split())
    with pytest.raises(ValueError, match="a Kalman filter must have an affine model .* operating_state=None"):
        tuning.compare(["kf"], problem, seeds=2, progress=False)


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


def test_relations_need_parameters_of_a_covariance_that_the_method_tunes_one_by_one():
    task = task_of(linear(), options={"where": TIED})
    refused("method 'em' must come without where", find_method("em").run, "em", task)
    with pytest.raises(ValueError, match="relations need a filter with a covariance, but got 'low-pass'"):
        Plan("low-pass", (find_scenario("nominal"),), where=("Q11 = 1",)).checked()


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
    refused("study 's' must be for .*where", open_study, "s", plan._replace(where=()), open_storage(path))


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
    refused(rule, model_parameters, linear(), where=where)
    refused(rule, Plan("kf", (linear(),), where=(*where, *["P0 = 1"] * ("R22 = 1" in where))).checked)
