"""Methods that search: their steps against naive ones, and where they end against where gradients end."""

import math

import numpy as np
import pytest

from tests.filters.checks import refused
from tests.tuning.methods.problems import P0, A, C, Q, R, at, linear, task_of
from tuning.evaluation.evaluate import values_of
from tuning.likelihood.gradient import tune_by_gradient
from tuning.methods.gradients import Factors
from tuning.methods.searches import BACKWARD, FORWARD, _squares
from tuning.methods.task import METHODS, Budget, Task, find_method
from tuning.plants.thruster import find_scenario
from tuning.search.plan import LIKELIHOOD, LOG_SCORE, MSE, SCORE

FULL = {"full_q": True, "full_r": True}


@pytest.mark.parametrize("objective", [LIKELIHOOD, MSE, LOG_SCORE])
def test_slopes_by_matrices_are_differences(objective):
    task = task_of(linear(missing=0.1))
    goal = task.goal(objective, keeps=False)
    q, r = np.array([[0.3, 0.1], [0.1, 0.2]]), np.array([[0.4, -0.1], [-0.1, 0.3]])

    def choice(q, r):
        noise = {"process_noise_cov": tuple(map(tuple, q)), "measurement_noise_cov": tuple(map(tuple, r))}
        return task.start._replace(model={**task.start.model, **noise})

    _, by_q, by_r = goal.by_noise(choice(q, r))
    for by, which in ((by_q, 0), (by_r, 1)):
        for i, j in ((0, 0), (1, 0), (1, 1)):
            step = np.zeros((2, 2))
            step[i, j] = step[j, i] = 1e-5
            sides = [(q + sign * step, r) if which == 0 else (q, r + sign * step) for sign in (1, -1)]
            above, below = (goal.by_noise(choice(*one))[0] for one in sides)
            expected = (above - below) / 2e-5
            assert np.trace(by @ step) / 1e-5 == pytest.approx(expected, rel=1e-6, abs=1e-6 * abs(by).max())


def test_slopes_by_matrices_of_diagonals_are_those_of_coordinates():
    task = task_of(linear())
    goal = task.goal(LIKELIHOOD, keeps=False)
    point = goal.coordinates.of(goal.untuned)
    _, by_q, by_r = goal.by_noise(goal.choice_at(point))
    slopes = np.concatenate([np.diag(by_q), np.diag(by_r)]) * goal.untuned
    np.testing.assert_allclose(goal(point).gradient, slopes, rtol=1e-9)
    refused("must not be 'score'", goal.with_changes(objective=SCORE).by_noise, task.start)


@pytest.mark.slow
def test_a_method_by_gradients_ends_where_the_gradient_method_ends():
    problem = find_scenario("mismatch")
    data = problem.data(range(8))
    for objective in (LIKELIHOOD, LOG_SCORE):
        task = Task("ekf", problem, data)
        find_method(objective).run(objective, task)
        expected = tune_by_gradient("ekf", problem, data, objective=objective)
        found, other = (task.value(one, objective) for one in (task.best, expected.choice))
        assert found == pytest.approx(other, rel=1e-8)


def test_slopes_of_cholesky_factors_are_differences():
    rng = np.random.default_rng(0)
    q, r = (one @ one.T + np.eye(len(one)) for one in (rng.standard_normal((3, 3)), rng.standard_normal((2, 2))))
    factors = Factors(q, r)
    weights = [one + one.T for one in (rng.standard_normal((3, 3)), rng.standard_normal((2, 2)))]

    def value(point):
        return sum((weight * cov).sum() for weight, cov in zip(weights, factors.matrices(point), strict=True))

    slopes = factors.slopes(factors.first, *weights)
    steps = 1e-6 * np.eye(len(factors.first))
    expected = [(value(factors.first + one) - value(factors.first - one)) / 2e-6 for one in steps]
    np.testing.assert_allclose(slopes, expected, rtol=1e-6)
    np.testing.assert_allclose(factors.matrices(factors.first)[0], q + 1e-6 * np.eye(3), rtol=1e-12)


@pytest.mark.slow
def test_okf_and_the_gradient_of_its_error_go_below_noise_estimation_where_the_model_is_wrong():
    problem = find_scenario("mismatch")
    values = {}
    for name in ("noise-estimation", "okf", MSE):
        task = Task("ekf", problem, problem.data(range(20)), options=FULL)
        find_method(name).run(name, task)
        values[name], best = task.value(task.best, MSE), task.best
        if name == "okf":  # rounding decides in which of several minima a search from afar ends
            onward = Task("ekf", problem, problem.data(range(20)), options=FULL, start=best)
            find_method(MSE).run(MSE, onward)
            assert onward.value(onward.best, MSE) < values["okf"] < values["noise-estimation"]
    assert values[MSE] < values["okf"] * 1.06


def test_coordinate_steps_go_up_by_a_tenth_or_down_by_half_and_nowhere_else():
    task = task_of(linear(runs=8))
    find_method("coordinate-steps").run("coordinate-steps", task)
    first = np.log([*task.start.model["process_noise_cov"], *task.start.model["measurement_noise_cov"]])
    values = []
    for answer in task.answers:
        model = answer.choice.model
        moved = np.log([*model["process_noise_cov"], *model["measurement_noise_cov"]]) - first
        for one in moved:  # a sum of whole numbers of both steps
            ups = (one - BACKWARD * np.arange(21)) / FORWARD
            assert abs(ups - ups.round()).min() < 1e-9
        values.append(task.value(answer.choice))
    assert (np.diff(values) < 1e-12).all() and len(values) > 3  # the first step is the start, but for rounding
    assert task.runs <= 8 * (2 * 4 * 20 + 1 + len(values))


WITHIN = {"nelder-mead": 1.002, "tpe-only": 1.08, "cma-es-only": 1.03, "random-only": 1.2}


@pytest.mark.parametrize(("name", "within"), WITHIN.items())
def test_searches_come_near_the_least_score(name, within):
    problem = linear(runs=8)
    best = task_of(problem, 8)
    find_method(SCORE).run(SCORE, best)
    task = task_of(problem, 8, budget=Budget(runs=1600))
    find_method(name).run(name, task)
    ratio = _score(task.best, problem) / _score(best.best, problem)
    assert 0.9999 < ratio < within


def _score(choice, problem):
    return values_of(choice.filter(problem), problem.data(range(8)), problem.scale).score.value


def test_the_error_of_masked_measurements_is_that_of_a_naive_filter_which_does_not_see_them():
    problem = linear(steps=20)
    task = task_of(problem)
    hidden = np.random.default_rng(3).random((4, 21)) < 0.5
    total, count = np.zeros(2), 0
    for z, gone in zip(task.data[0].measurements, hidden, strict=True):
        mean, cov = np.zeros(2), P0
        for k in range(21):
            if k:
                mean, cov = A @ mean, A @ cov @ A.T + Q
            if gone[k]:
                total, count = total + (z[k] - C @ mean) ** 2, count + 1
            else:
                gain = cov @ C.T @ np.linalg.inv(C @ cov @ C.T + R)
                mean, cov = mean + gain @ (z[k] - C @ mean), cov - gain @ C @ cov
    right = at(task, np.diag(Q), np.diag(R))
    np.testing.assert_allclose(_squares(task, right, 0, hidden), total / count, rtol=1e-9)


def test_masked_measurements_find_the_ratio_of_q_and_r():
    problem = linear(a=np.eye(1), c=np.eye(1), q=[[1.0]], r=[[4.0]], p0=np.eye(1), steps=400, runs=8)
    task = task_of(problem, 8)
    find_method("masked").run("masked", task)
    model = task.best.model
    assert model["process_noise_cov"][0] / model["measurement_noise_cov"] == pytest.approx(0.25, rel=0.3)


@pytest.mark.slow
def test_two_sample_times_find_the_q_and_r_of_a_level_where_one_leaves_a_curve_of_zeros():
    problem = linear(a=np.eye(1), c=np.eye(1), q=[[1.0]], r=[[4.0]], p0=np.eye(1), steps=400, runs=32)
    box, ratios = {"where": ("Q11 = 0.05..20", "R = 0.2..80")}, {"c-nis": [], "c-nis-two-rates": []}
    for seed in range(3):
        for name, found in ratios.items():
            task = task_of(problem, 32, options=box, seed=seed, budget=Budget(runs=5000))
            task.start = at(task, [5.0], [0.5])
            find_method(name).run(name, task)
            model = task.best.model
            found.append(np.log([model["process_noise_cov"][0], model["measurement_noise_cov"] / 4]))
    away = {name: np.median(abs(np.array(found)), axis=0) for name, found in ratios.items()}
    assert (away["c-nis-two-rates"] < 0.15).all() and away["c-nis"][0] > 0.4, away
    on_the_curve = at(task, [0.1], [8.784])  # where a naive filter's mean NIS is 1, too
    single, slower = (task._value(on_the_curve, "nis", data) for data in (task.data, [task.data[0].every(10)]))
    assert single < 0.01 and slower > 0.5


def test_a_slower_sample_time_has_the_likelihood_of_a_model_of_ten_steps():
    problem = linear(steps=50)
    task = task_of(problem)
    data = task.data[0].every(10)
    expected = 0.0
    z, mean, cov = task.data[0].measurements[0, ::10], np.zeros(2), P0
    for k in range(6):
        for _ in range(10 if k else 0):
            mean, cov = A @ mean, A @ cov @ A.T + Q
        s, d = C @ cov @ C.T + R, z[k] - C @ mean
        expected -= 0.5 * (d @ np.linalg.solve(s, d) + np.linalg.slogdet(2 * np.pi * s)[1])
        gain = cov @ C.T @ np.linalg.inv(s)
        mean, cov = mean + gain @ d, cov - gain @ C @ cov
    filter_ = at(task, np.diag(Q), np.diag(R)).filter(problem)
    assert values_of(filter_, data.slice(0, 1), problem.scale).log_likelihood == pytest.approx(expected)
    assert np.isfinite(data.measurements).all(axis=2).sum() == 4 * 6


@pytest.mark.parametrize(("name", "within"), [("vb", 0.1), ("sage-husa", 0.3)])  # the latter moves Q, too
def test_adaptive_filters_converge_to_the_r_of_a_level(name, within):
    problem = linear(a=np.eye(1), c=np.eye(1), q=[[1.0]], r=[[4.0]], p0=np.eye(1), steps=600, runs=8)
    task = task_of(problem, 8)
    task.start = at(task, [1.0], [1.0])
    find_method(name).run(name, task)
    assert task.best.model["measurement_noise_cov"] == pytest.approx(4.0, rel=within)
    assert task.runs == 8


def test_innovations_of_ensembles_tell_r_and_a_factor_on_q():
    problem = find_scenario("nominal")
    task = Task("enkf", problem, problem.data(range(16)), start=None)
    true = problem.true
    q = tuple(4.0 * q for q in true["process_noise_cov"])
    task.start = task.start._replace(model={"process_noise_cov": q, "measurement_noise_cov": 0.5})
    find_method("desroziers").run("desroziers", task)
    found = task.best.model
    assert found["measurement_noise_cov"] == pytest.approx(true["measurement_noise_cov"], rel=0.1)
    ratios = np.divide(found["process_noise_cov"], true["process_noise_cov"])
    assert ratios == pytest.approx(np.full(2, ratios[0])) and abs(math.log(ratios[0])) < math.log(1.6)


def test_every_method_says_what_it_is_and_whose():
    for name, method in METHODS.items():
        assert method.about and method.when and method.source and name == name.lower()


def test_a_gradient_begins_within_the_ranges_where_the_start_has_a_correlation_of_one():
    problem = linear()
    task = task_of(problem, options=FULL)
    task.start = task.start._replace(model={**task.start.model, "process_noise_cov": ((0.04, 0.08), (0.08, 0.16))})
    find_method(LOG_SCORE).run(LOG_SCORE, task)
    assert task.value(task.best, LOG_SCORE) < task.value(task.start, LOG_SCORE)
