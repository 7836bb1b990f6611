"""What gradients lead to, and full Q and R: values are those of evaluations, gradients those of differences."""

import json

import gymnasium as gym
import numpy as np
import optuna
import pytest
from rich.console import Console

import thruster_env  # noqa: F401 - registers the env
import tuning
from filters import EstimateState, run
from filters.tuned_file import read_tuned_file, sealed
from tests.filters.checks import refused
from tests.linear_problem import LinearProblem
from tests.models import state_space
from tests.slow import slow_but
from tuning.api.tune import run_tuning
from tuning.api.verify import verify
from tuning.evaluation.evaluate import evaluate
from tuning.evaluation.held_out import evaluate_held_out
from tuning.evaluation.tuned import read_tuned, write_tuned
from tuning.likelihood.gradient import goal_of, tune_by_gradient
from tuning.plants.thruster import find_scenario
from tuning.problems.model_problem import ModelProblem
from tuning.problems.problem import Parameter
from tuning.reporting.tables import choice_table
from tuning.search.among_types import BY_GRADIENT, MAXIMUM_LIKELIHOOD_AFTER, RESCALED
from tuning.search.parameters import correlation_slopes, correlations_of, full_covariance
from tuning.search.plan import LIKELIHOOD, OBJECTIVES, Plan
from tuning.search.space import choice_of, parameters_of, trial_parameters, untuned_choice
from tuning.search.study import open_study, run_study

NAMES = "startup", "nominal", "published_noise", "mismatch"
STARTUP, NOMINAL, NOISY, MISMATCH = map(find_scenario, NAMES)


def decay(x, u, c):
    return (x[0] + 0.1 * (u[0] - c[0] * x[0] - 0.1 * x[0] * x[0] * x[0]), x[1] + 0.05 * (x[0] - x[1]))


def both(x, c):
    return (x[0] + x[1] + c[1], x[1])


def vessel(drag=0.5, noise=0.05, offset=0.2):
    """A model whose constants, noise and prior have parameters, one of them on a linear scale."""
    q, r = [noise**2, 1e-3], [[0.01, 0.002 * drag], [0.002 * drag, 0.02]]
    mean, cov = [1.0 + offset, 0.0], [drag, 1.0]
    return state_space(decay, both, q=q, r=r, mean=mean, cov=cov, constants=(drag, offset))


def of_own_numbers(first_scored_step):
    """A problem with parameters that move all numbers of a model."""
    free = [Parameter("drag", 0.1, 2.0), Parameter("noise", 1e-3, 1.0), Parameter("offset", -1.0, 1.0, log=False)]
    name = f"vessel from {first_scored_step}"
    inputs = np.ones((40, 1))
    return ModelProblem(vessel(), vessel, inputs, first_scored_step=first_scored_step, parameters=free, name=name)


def drift(x, u, c):
    return (*decay(x, u, c), x[2])


def with_drift(x, c):
    return (x[0] + x[1] + c[1] + x[2], x[1])


def of_one_more_state():
    """A problem whose filters assume one more state than the plant has."""
    noise = {"process_noise_cov": [0.01, 1e-3, 1e-5], "prior_mean": [1.2, 0.0, 0.0], "prior_cov": [0.5, 1.0, 0.1]}
    assumed = vessel().replace(transition=drift, observe=with_drift, states=None, **noise)
    return ModelProblem(vessel(), assumed, np.ones((40, 1)), first_scored_step=3, name="vessel with a drift")


CASES = {
    "correlation and prior": ("ekf", [STARTUP], {"full_q": True, "prior": True}),
    "R held": ("ukf", [NOISY], {"hold_r": True}),
    "own numbers": ("ckf", [of_own_numbers(3)], {}),
    "one more state": ("iekf", [of_one_more_state()], {}),
    "several problems": ("ekf", [of_own_numbers(0), of_own_numbers(30)], {}),
    "affine": ("kf", [NOISY], {}),
}


def level(goal, choice, problems, data):
    """The objective of a choice, as a study evaluates it with the filter that runs."""
    pairs = [(choice.filter(one), runs, one.scale) for one, runs in zip(problems, data, strict=True)]
    if goal.objective == LIKELIHOOD:  # of all steps, where no lead-in is left out
        some = [run(one, runs.filter_keys, runs.inputs, runs.measurements) for one, runs, _ in pairs]
        return sum(one.log_likelihoods.sum() for one in some)
    found = [evaluate(*one) for one in pairs]
    return np.mean([OBJECTIVES[goal.objective].value(one, np.nan) for one in found])


OBJECTIVE = ["likelihood", "score", "mse", "log-score"]
LIGHT = {  # each of the others is compiled for a second or two
    *(("own numbers", objective) for objective in OBJECTIVE),
    ("affine", "score"),
    ("correlation and prior", "likelihood"),
    ("R held", "log-score"),
}


@pytest.mark.parametrize(
    ("case", "objective"),
    [
        pytest.param(case, objective, marks=[] if (case, objective) in LIGHT else pytest.mark.slow)
        for case in CASES
        for objective in OBJECTIVE
        if (case, objective) in LIGHT or (objective == "likelihood" and case not in dict(LIGHT))
    ],
)
def test_a_goal_is_the_objective_of_the_filter_that_runs_and_its_gradient_that_of_differences(case, objective):
    name, problems, options = CASES[case]
    data = [problem.data(range(3)) for problem in problems]
    goal = goal_of(name, problems, data, objective, options)
    point = goal.coordinates.of(goal.untuned) + np.linspace(0.1, 0.3, len(goal.untuned))
    found = goal(point)
    value = level(goal, goal.choice_at(point), problems, data)
    assert goal.level(found.value) == pytest.approx(value, rel=1e-9)
    unit = found.value / value
    slopes = []
    for step in 1e-4 * np.eye(len(point)):
        above, below = (level(goal, goal.choice_at(point + sign * step), problems, data) for sign in (1, -1))
        slopes.append(unit * (above - below) / 2e-4)
    tolerance = 1e-6 * np.abs(slopes).max()
    np.testing.assert_allclose(found.gradient, slopes, rtol=1e-5, atol=tolerance)


def test_the_numbers_of_a_model_are_found_together_whatever_they_move():
    problem = of_own_numbers(3)
    data = problem.data(range(40))
    found = tune_by_gradient("ekf", problem, data)
    assert found.agree and found.identified.all() and found.names == ("drag", "noise", "offset")
    distances = (found.best.parameters - [0.5, 0.05, 0.2]) / [0.5, 0.05, 1.0]  # errors are of two logarithms
    assert (abs(distances) < 3.5 * found.standard_errors).all() and (found.standard_errors < 0.2).all()


@pytest.mark.slow
def test_a_full_q_is_at_least_as_likely_as_a_diagonal_one_and_a_study_tries_it():
    plan = Plan("ekf", (MISMATCH,), objectives=("log-score",), full_q=True)
    data = plan.training_data()
    some = [one.slice(0, 8) for one in data]
    diagonal = tune_by_gradient("ekf", plan.scenarios, some, [1.0], "log-score")
    full = tune_by_gradient("ekf", plan.scenarios, some, [1.0], "log-score", plan.options)
    assert full.names == ("Q11", "Q22", "correlation_12", "R") and full.best.level < diagonal.best.level
    choice = full.choice.model["process_noise_cov"]
    assert np.shape(choice) == (2, 2) and abs(full.best.parameters[2]) > 0.01
    result = run_study(open_study("full", plan), plan, 8)
    best = tune_by_gradient("ekf", plan.scenarios, data, [1.0], "log-score", plan.options).best
    assert result.best_value == pytest.approx(best.level, rel=1e-4)


def blown(x, u, c):
    return (x[0] * x[0] * x[0] + c[0], 0.5 * x[1])


def unseen(x, c):
    return (x[1], x[1] + x[0] * 1e-12)


def test_where_the_filter_diverges_from_every_start_nothing_is_determined():
    assumed = vessel().replace(transition=blown, observe=unseen, prior_mean=[9.0, 0.0])
    problem = ModelProblem(vessel(), assumed, np.ones((40, 1)), first_scored_step=3, name="blown")
    found = tune_by_gradient("ekf", problem, problem.data(range(3)), [1.0])
    assert not found.identified.any() and np.isinf(found.standard_errors).all()
    assert found.best.parameters == pytest.approx(goal_of("ekf", problem, problem.data([1])).untuned)


def test_problems_of_a_list_have_one_optimum():
    both = NOISY, NOMINAL
    data = [one.data(range(8)) for one in both]
    found = tune_by_gradient("ekf", both, data, [1.0])
    alone = [tune_by_gradient("ekf", one, runs, [1.0]) for one, runs in zip(both, data, strict=True)]
    assert found.best.value < sum(one.best.value for one in alone) - 1.0
    goal = goal_of("ekf", both, data)
    best = goal.coordinates.of(found.best.parameters)
    assert abs(goal(best).gradient).max() < 1e-3 * abs(goal(best + 0.1).gradient).max()


def of_two_sensors(**assumed):
    """A walk measured by two sensors, whose noise is correlated; filters assume that it is not."""
    noise = {"q": [0.01, 0.04], "r": [[1.0, 1.2], [1.2, 4.0]], "mean": [0.0, 0.0], "cov": [1.0, 1.0]}
    functions = (lambda x, u, c: (x[0], 0.9 * x[1])), (lambda x, c: (x[0] + x[1], x[1]))
    truth = state_space(*functions, **noise, inputs=0)
    return ModelProblem(truth, truth.replace(measurement_noise_cov=[1.0, 4.0]), steps=200, **assumed)


@pytest.mark.slow
def test_correlated_sensors_are_found():
    plan = Plan("ekf", (of_two_sensors(),), full_q=True, full_r=True).checked()
    found = tune_by_gradient("ekf", plan.scenarios, plan.training_data(), [1.0], options=plan.options)
    assert found.names == ("Q11", "Q22", "correlation_12", "R11", "R22", "R_correlation_12")
    at, error = found.best.parameters[-1], found.standard_errors[-1]
    assert abs(at - 0.6) < 3.5 * error < 0.2 and found.identified[-1]


@pytest.mark.slow
def test_a_full_r_is_read_back_wherever_a_tuned_file_is(tmp_path):
    plan = Plan("ekf", (of_two_sensors(),), full_q=True, full_r=True).checked()
    file = tmp_path / "full.json"
    result = run_tuning(plan, 8, Console(quiet=True), out=file, method="gradient")
    choice, *_ = read_tuned(file, plan.scenarios)
    assert np.array(choice.model["measurement_noise_cov"])[0, 1] > 0.5 and choice == result.result.choice
    again = choice_of("ekf", parameters_of(choice), plan.scenarios[0])
    digests = {one.filter(plan.scenarios[0]).model.digest for one in (choice, again)}
    assert len(digests) == 1
    ratios = result.comparison.ratios
    assert result.comparison.true is not None and abs(ratios["oracle"].value - 1.0) < 0.01
    assert plan.identity["full_r"] and "full_r" not in plan._replace(full_r=False).identity


@pytest.mark.parametrize(
    ("plan", "rule"),
    [
        (Plan("ekf", (of_two_sensors(),), full_r=True, hold_r=True), "R must be free to be full, but got hold_r"),
        (Plan("low-pass", (NOMINAL,), full_r=True), "a full R needs a filter with a cov.* 'low-pass'"),
        (Plan("ekf", (of_own_numbers(0),), full_r=True), "a full R .* tunes drag, noise, offset"),
    ],
)
def test_a_full_r_that_cannot_be_is_refused(plan, rule):
    refused(rule, plan.checked)


def test_of_one_channel_a_full_r_is_its_variance():
    full = Plan("ekf", (NOMINAL,), full_q=True, full_r=True).checked()
    assert list(full.parameters()) == list(full._replace(full_r=False).checked().parameters())


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
            model = {"process_noise_cov": tuple(moved[:2]), "measurement_noise_cov": tuple(moved[2:])}
            assert least <= value_of(objective, found.choice._replace(model=model), MISMATCH, data) * (1 + 1e-9)


def test_a_study_of_an_objective_that_has_a_gradient_tries_where_it_leads_and_finds_nothing_much_better():
    plan = Plan("ekf", (MISMATCH,), objectives=("log-score",), consistent=False)
    result = run_study(open_study("gradient", plan), plan, MAXIMUM_LIKELIHOOD_AFTER + 2)
    (tried,) = [trial for trial in result.trials if BY_GRADIENT in trial.user_attrs]
    assert 0 < tried.number < 6 and tried.user_attrs[BY_GRADIENT] == "log-score"
    found = tune_by_gradient("ekf", MISMATCH, plan.training_data()[0], [1.0], "log-score")
    assert [tried.params[name] for name in found.names] == pytest.approx(found.best.parameters)
    assert result.best_value == pytest.approx(found.best.level, rel=1e-6)


def test_objectives_on_true_states_need_them_and_a_gradient_takes_no_budget():
    data = MISMATCH.data(range(2))
    with pytest.raises(ValueError, match="must be 'likelihood' without true states, but got 'mse'"):
        tune_by_gradient("ekf", MISMATCH, data._replace(states=None), objective="mse")
    with pytest.raises(ValueError, match="objective must be one of likelihood, score, mse, .*, but got 'nees'"):
        tune_by_gradient("ekf", MISMATCH, data, objective="nees")
    with pytest.raises(ValueError, match="must come without a budget, but got budget"):
        tuning.tune("mismatch", "ekf", budget=1.0, method="gradient")


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


FULL = Plan("ekf", (MISMATCH,), full_q=True)


def test_full_covariances_have_the_correlations_that_they_are_made_of():
    cov = full_covariance((4.0, 9.0), [-0.5])
    np.testing.assert_allclose(cov, [[4.0, -3.0], [-3.0, 9.0]], rtol=1e-15)
    assert (full_covariance((4.0, 9.0), [0.0]) == np.diag([4.0, 9.0])).all()
    cov = full_covariance((1.0, 2.0, 3.0), [0.3, -0.6, 0.7])
    known = cov[1:, 1:] - np.outer(cov[1:, 0], cov[0, 1:]) / cov[0, 0]
    assert known[0, 1] / np.sqrt(known[0, 0] * known[1, 1]) == pytest.approx(0.7)
    cov = full_covariance((1.0, 0.0, 4.0), [0.3, 0.5, -0.2])
    assert (cov[1] == 0.0).all() and cov[0, 2] == pytest.approx(0.5 * 2.0)


@pytest.mark.parametrize("n", [1, 2, 3, 5])
def test_any_numbers_within_their_ranges_give_a_covariance_and_come_back(n):
    generator = np.random.default_rng(n)
    for _ in range(20):
        variances = np.exp(generator.normal(0.0, 3.0, n))
        correlations = generator.uniform(-0.99, 0.99, n * (n - 1) // 2)
        cov = full_covariance(variances, correlations)
        assert (cov == cov.T).all() and np.linalg.eigvalsh(cov)[0] > 0
        np.testing.assert_allclose(np.diag(cov), variances, rtol=1e-12)
        np.testing.assert_allclose(correlations_of(cov), correlations, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize(
    ("arguments", "rule"),
    [
        (((1.0, -1.0), [0.1]), "variances must be at least zero, but got"),
        (((1.0, 1.0), [1.01]), "correlations must be 1 numbers from -1 to 1"),
        (((1.0, 1.0), []), "correlations must be 1 numbers from -1 to 1"),
    ],
)
def test_other_numbers_are_refused(arguments, rule):
    refused(rule, full_covariance, *arguments)


def test_a_choice_with_a_full_q_survives_its_trial_parameters():
    choice = untuned_choice("enkf", MISMATCH)
    q = tuple(map(tuple, full_covariance(choice.model["process_noise_cov"], [0.4]).tolist()))
    choice = choice._replace(model={**choice.model, "process_noise_cov": q})
    parameters = parameters_of(choice)
    assert parameters["correlation_12"] == pytest.approx(0.4)
    again = choice_of("enkf", parameters, MISMATCH)
    np.testing.assert_allclose(again.model["process_noise_cov"], q, rtol=1e-12)
    np.testing.assert_array_equal(choice.filter(MISMATCH).model.process_noise_cov, q)
    assert trial_parameters(untuned_choice("enkf", MISMATCH), FULL.space())["correlation_12"] == 0.0


def test_a_study_of_a_full_q_ends_in_a_file_that_everything_reads(tmp_path):
    result = run_study(open_study("s", FULL, optuna.storages.InMemoryStorage()), FULL, 14)
    q = np.array(result.choice.model["process_noise_cov"])
    assert q.shape == (2, 2) and q[0, 1] == q[1, 0] != 0.0
    path = tmp_path / "t.json"
    write_tuned(path, FULL, result, [evaluate_held_out(result.choice, MISMATCH, 0, 4)], "s")
    assert read_tuned(path) == (result.choice, MISMATCH, 0) and verify(path).holds
    env = EstimateState(gym.make("BowThruster-v0"), tuned=str(path))
    np.testing.assert_array_equal(env.filter.model.process_noise_cov, q)
    shown = choice_table({"untuned": untuned_choice("ekf", MISMATCH), "tuned": result.choice}, MISMATCH)
    assert "correlation 12" in [row[0] for row in shown.rows]

    content = read_tuned_file(path)
    content["filter"]["model"]["process_noise_cov"][0][1] *= -1
    path.write_text(json.dumps(sealed(content)))
    refused("process_noise_cov must be 2 variances or a symmetric 2 x 2 matrix", read_tuned, path)


def test_a_consistent_twin_has_the_same_correlation():
    result = run_study(open_study("s", FULL, optuna.storages.InMemoryStorage()), FULL, 12)
    twins = [trial for trial in result.trials if RESCALED in trial.user_attrs and "R" in trial.params]
    assert twins
    for rescaled in twins:
        trial = result.trials[rescaled.user_attrs[f"{RESCALED} of"]]
        assert rescaled.params["correlation_12"] == trial.params["correlation_12"]
        of_q, of_r = (rescaled.params[name] / trial.params[name] for name in ("Q11", "R"))
        assert of_r == pytest.approx(of_q)


@pytest.mark.parametrize("correlations", [[0.3, -0.6, 0.7, 0.0, 0.98, -0.2], [0.0] * 6])
def test_derivatives_of_a_full_covariance_are_those_of_differences(correlations):
    variances, steps = (1.0, 2.0, 3.0, 0.5), 1e-6 * np.eye(6)
    found = correlation_slopes(variances, correlations)
    for slope, step in zip(found, steps, strict=True):
        above, below = (full_covariance(variances, np.add(correlations, sign * step)) for sign in (1, -1))
        np.testing.assert_allclose(slope, (above - below) / 2e-6, rtol=1e-7, atol=1e-8)


def test_correlations_of_a_singular_covariance_are_those_that_something_determines():
    g = np.array([0.005, 0.1])  # one acceleration drives position and speed
    assert correlations_of(np.outer(g, g)) == [pytest.approx(1.0, abs=1e-12)]
    assert correlations_of(np.outer([1.0, -2.0], [1.0, -2.0])) == [pytest.approx(-1.0, abs=1e-12)]
    assert correlations_of(np.zeros((3, 3))) == [0.0] * 3
    third = np.array([[1.0, 0.0, 1.0], [0.0, 4.0, 2.0], [1.0, 2.0, 2.0]])  # first and half the second
    assert correlations_of(third) == pytest.approx([0.0, np.sqrt(0.5), 1.0], abs=1e-12)
    both = np.array([[4.0, 4.0, 1.0], [4.0, 4.0, 1.0], [1.0, 1.0, 9.0]])  # the second is the first
    assert correlations_of(both) == pytest.approx([1.0, 1.0 / 6.0, 0.0], abs=1e-12)
