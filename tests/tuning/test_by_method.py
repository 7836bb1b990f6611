"""Methods of tuning by the functions and commands of users: a study whose choice is the method's answer."""

import json
import signal

import numpy as np
import pytest

import tuning
from tests.filters.checks import refused
from tests.linear_problem import LinearProblem
from tests.tuning.methods.problems import linear
from thruster_env.model.affine import affine_model
from tuning.api import tune
from tuning.evaluation.baselines import same_filter
from tuning.evaluation.tuned import read_tuned
from tuning.likelihood.gradient import tune_by_gradient
from tuning.methods.innovations import steady_gain
from tuning.methods.task import ALONE, METHODS, Budget, Task, find_method, stationary
from tuning.problems.find import find_problem
from tuning.problems.model_problem import RunsProblem
from tuning.search.plan import TRAINING_SEEDS, Plan, reported, reported_name
from tuning.search.space import given_choice, untuned_choice

SHORT = find_problem("nominal").replace(steps=70, name="short")


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_a_method_gives_its_answer_its_file_and_its_held_out_table(tmp_path):
    study = tuning.tune(SHORT, "ekf", method="likelihood", trials=10, progress=False)
    data = SHORT.data(SHORT.training_seeds(0, TRAINING_SEEDS))
    expected = tune_by_gradient("ekf", SHORT, data).choice
    for name in ("process_noise_cov", "measurement_noise_cov"):
        np.testing.assert_allclose(study.choice.model[name], expected.model[name], rtol=1e-4)
    assert "Method likelihood: maximum likelihood" in str(study) and "held-out" in str(study)
    assert 0 < len(study.trials) <= 10 and study.consistent is None
    file = study.save(tmp_path / "tuned.json")
    written = json.loads(file.read_text())
    assert written["study"]["method"] == "likelihood"
    choice, *_ = read_tuned(file, [SHORT])
    np.testing.assert_allclose(choice.model["process_noise_cov"], study.choice.model["process_noise_cov"])
    assert study.report(tmp_path / "page.html").page.is_file()


def test_the_same_command_goes_on_with_the_answer_that_is_there(tmp_path):
    storage = tmp_path / "studies.journal"
    options = {"filter": "kf", "trials": 6, "progress": False, "storage": storage}
    first = tuning.tune("published_tunnel", method="noise-estimation", **options)
    again = tuning.tune("published_tunnel", method="noise-estimation", **options)
    assert again.choice == first.choice and len(again.trials) == len(first.trials)
    assert again.answer.runs == first.answer.runs == TRAINING_SEEDS
    assert np.shape(first.choice.model["process_noise_cov"]) == (2, 2)  # where trials have diagonals


@pytest.mark.parametrize(
    ("problem", "options", "words"),
    [
        (LinearProblem(truth=False), {"method": "mse"}, "method 'mse' needs true states, but linear-3 has none"),
        ("nominal", {"method": "em", "filter": "enkf"}, "a filter for method 'em' must be one of kf"),
        ("nominal", {"method": "als"}, "method 'als' needs a linear model"),
        ("nominal", {"method": "magic"}, "method must be one of"),
        ("nominal", {"method": "em", "worst": True}, "must minimise the mean over problems"),
        ("nominal", {"method": "squarem", "space": tuning.SearchSpace(full_q=True)}, "must come without full_q"),
    ],
)
def test_what_a_method_lacks_is_said_in_one_line(problem, options, words):
    refused(words, tuning.tune, problem, **{"filter": "ekf", **options}, trials=3, progress=False)


@pytest.mark.parametrize(("method", "former"), [("likelihood", "likelihood"), ("random-only", "random")])
def test_a_journal_that_says_way_is_continued(tmp_path, monkeypatch, method, former):
    """As `tune` wrote it before methods had one name."""
    problem, storage = singular(first_scored_step=50), tmp_path / "studies.journal"
    options = {"filter": "kf", "trials": 2, "progress": False, "storage": storage, "method": method}
    plan = Plan("kf", (problem,), objectives=("likelihood",))
    with monkeypatch.context() as before:
        before.setattr(tune, "ANSWER", "answer of the way")
        name = f"{tune.name_of(plan)}-way-{former}"
        first = tuning.tune(problem, name=name, **options)
    monkeypatch.setattr(tune, "Task", None)  # nothing is run again
    again = tuning.tune(problem, **options)
    assert same_filter(again.choice, first.choice) and again.name == name
    assert again.answer.runs == first.answer.runs


def test_a_study_cannot_be_run_on_a_task():
    problem = singular()
    with pytest.raises(ValueError, match="a study must be run by tuning.tune"):
        find_method("tpe").run("tpe", Task("kf", problem, problem.data([0])))


def test_the_command_lists_methods_with_what_they_need_and_one_in_full(thruster):
    assert "true states" in thruster("methods").stdout
    shown = thruster("methods", "EM").stdout
    assert "Shumway" in shown and "dlog L/dq" in shown


@pytest.mark.slow
def test_gradients_of_full_matrices_begin_at_noise_estimation():
    options = {"space": tuning.SearchSpace(full_q=True), "trials": 6, "progress": False}
    study = tuning.tune("deadband", "ekf", method="log-score", **options)
    ratios = study.held_out.ratios
    assert ratios["noise estimation"].high < 0.85 and ratios["scaled default"].high < 0.5
    assert study.held_out.evaluation.nees.value == pytest.approx(2.0, rel=0.1)


def test_ctrl_c_ends_a_method_with_what_it_has_found(monkeypatch, tmp_path):
    def follow(task):
        task.keep(task.with_values([2.0 * one for one in task.values_of(task.start, task.free)], task.free))
        signal.raise_signal(signal.SIGINT)
        task.value(task.best)
        raise AssertionError("it went on")

    monkeypatch.setattr(tune, "find_method", lambda name: METHODS["random-only"]._replace(function=follow))
    study = tuning.tune(SHORT, "ekf", method="random-only", trials=4, progress=False)
    assert study.interrupted and len(study.trials) == 2
    before = SHORT.untuned["process_noise_cov"]
    np.testing.assert_allclose(study.choice.model["process_noise_cov"], np.multiply(2.0, before))
    assert study.save(tmp_path / "tuned.json").is_file()


def singular(first_scored_step=0, runs=6, steps=60):
    """Runs of a position and a velocity that one noise drives, without true states."""
    rng, drive = np.random.default_rng(0), np.array([0.005, 0.1])
    a, c = np.array([[1.0, 0.1], [0.0, 0.95]]), np.array([[1.0, 0.0]])
    model = affine_model(A=a, C=c, Q=np.outer(drive, drive), R=[0.04], P0=[0.5, 0.5])
    found = []
    for _ in range(runs):
        x, rows = rng.normal(size=2), []
        for _ in range(steps):
            rows.append(x[:1] + 0.2 * rng.normal(size=1))
            x = a @ x + drive * rng.normal()
        found.append({"measurements": np.array(rows)})
    return RunsProblem(found, model, first_scored_step=first_scored_step, name="driven")


@pytest.mark.parametrize("method", ["em", "squarem", "als", "mehra"])
def test_methods_of_q_and_r_alone_say_how_p0_is_left_out(method):
    with pytest.raises(ValueError, match="P0 is tuned.*first_scored_step=50 of RunsProblem.*'likelihood'") as said:
        tuning.tune(singular(), "kf", method=method, trials=3, progress=False)
    assert "\n" not in str(said.value)
    problem = singular(first_scored_step=50)
    task = Task("kf", problem, problem.data([0, 1]), options={"prior": problem.counts_start_up})
    METHODS[method].check(method, task)


def with_larger_r(task):
    """A method that believes the measurements far too little."""
    task.keep(task.with_values([1e3 * one for one in task.values_of(task.start, task.free)], task.free))


def test_an_answer_that_is_worse_than_the_start_is_not_given(monkeypatch, tmp_path):
    monkeypatch.setitem(METHODS, "scoring", METHODS["scoring"]._replace(function=with_larger_r))
    problem, options = singular(first_scored_step=50), {"trials": 3, "progress": False}
    storage = tmp_path / "studies.journal"
    study = tuning.tune(problem, "kf", method="scoring", storage=storage, **options)
    assert same_filter(study.choice, given_choice("kf", problem))
    refused = study.answer.refused
    assert refused.after > refused.before == pytest.approx(study.result.best_value)
    again = tuning.tune(problem, "kf", method="scoring", storage=storage, **options)
    objective = study.plan.objectives[0]
    for one in (study, again):
        answer, given = (f"{reported(objective, value):.4g}" for value in (refused.after, refused.before))
        assert f"a {reported_name(objective)} of {answer} and the given filter {given}," in one.chosen[0]


@pytest.mark.parametrize("options", [{}, {"space": tuning.SearchSpace(hold_r=True)}])
def test_an_answer_is_no_worse_than_the_numbers_of_the_model(monkeypatch, options):
    keeps_the_rule_of_thumb = METHODS["scoring"]._replace(function=lambda task: None)
    monkeypatch.setitem(METHODS, "scoring", keeps_the_rule_of_thumb)
    problem = singular(first_scored_step=50)
    study = tuning.tune(problem, "kf", method="scoring", trials=2, progress=False, **options)
    own, found = given_choice("kf", problem).model, study.choice.model
    r = (untuned_choice("kf", problem).model if options else own)["measurement_noise_cov"]
    np.testing.assert_array_equal(found["process_noise_cov"], own["process_noise_cov"])
    np.testing.assert_array_equal(found["measurement_noise_cov"], r)
    refused = study.answer.refused
    assert refused.before < refused.after and "so that one is returned" in study.chosen[0]


@pytest.mark.parametrize(("method", "options"), [("em", {}), ("em", {"full_r": True}), ("squarem", {})])
def test_em_leaves_the_variance_of_a_channel_that_is_never_measured(method, options):
    rng = np.random.default_rng(0)
    model = affine_model(A=[[0.9]], C=[[1.0], [1.0]], Q=[0.01], R=[0.04, 0.09], P0=[0.1])
    runs = [{"measurements": np.column_stack([rng.normal(size=20), np.full(20, np.nan)])} for _ in range(4)]
    problem = RunsProblem(runs, model, held_out=[2, 3], name="half of it")
    task = Task("kf", problem, problem.data([0, 1]), options={"prior": False, **options}, budget=Budget(runs=400))
    METHODS[method].run(method, task)
    models = (one.filter(problem).model for one in (task.start, task.best))
    before, after = (np.asarray(model.measurement_noise_cov) for model in models)
    assert after[1, 1] == pytest.approx(before[1, 1]) and after[0, 0] > 2 * before[0, 0]


def test_methods_by_lags_refuse_a_filter_whose_errors_do_not_decay():
    linear_model = stationary(singular().model(), "driven", "als")
    with pytest.raises(ValueError, match="an eigenvalue of A - A L C is 1: its errors do not decay") as refused:
        steady_gain(linear_model, np.zeros((2, 2)), np.eye(1))
    assert "\n" not in str(refused.value)


@pytest.mark.slow
@pytest.mark.parametrize("method", [one for one in ALONE if one not in ("nuts", "posterior")])
def test_no_method_returns_worse_than_it_was_given(method):
    problem = singular(first_scored_step=50)
    task = Task("kf", problem, problem.data(range(4)), budget=Budget(300, 1.0))
    try:
        find_method(method).run(method, task)
    except ValueError as lacking:
        assert "needs" in str(lacking) or "tunes" in str(lacking)
    meter = Task("kf", problem, problem.data(range(4)))
    assert meter.value(task.best) <= meter.value(task.start) * (1 + 1e-6)


def test_em_with_long_steps_ends_where_a_variance_goes_to_zero():
    """It took 20 000 steps and minutes for some sixty rows."""
    problem = linear(runs=2, steps=30, truth=False)
    task = Task("kf", problem, problem.data([0, 1]), options={})
    find_method("squarem").run("squarem", task)
    assert task.runs < 20_000
    assert task.value(task.best) == pytest.approx(64.2459381973658, abs=1e-4)  # of method "likelihood"
