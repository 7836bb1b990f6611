"""Methods whose answers are known: closed forms, published figures, integrals on a grid, steps of a smoother."""

import numpy as np
import pytest

from filters import affine_model
from tests.filters.checks import refused
from tests.slow import slow_but
from tests.tuning.methods.problems import P0, A, C, Q, R, at, linear, task_of
from tests.tuning.test_series import NILE
from thruster_env.model.simulate import simulate
from tuning.evaluation.evaluate import values_of
from tuning.evaluation.residuals import estimated_from
from tuning.experiments.methods_problems import ring
from tuning.likelihood.objective import symmetric_units
from tuning.methods.gradients import counts_of
from tuning.methods.innovations import (
    Noise,
    autocovariances,
    lagged,
    mehra_equations,
    semidefinite,
    steady_gain,
    updated,
)
from tuning.methods.task import Budget, Task, find_method, stationary
from tuning.problems.model_problem import ModelProblem, RunsProblem
from tuning.problems.problem import Parameter
from tuning.search.plan import LIKELIHOOD


def level(q=1000.0, r=10000.0, start=0.0, wide=1e7):
    """A level that wanders, seen with noise."""
    one = np.eye(1)
    noise = {"process_noise_cov": [q], "measurement_noise_cov": r}
    return affine_model(a=one, b=np.zeros((1, 0)), c=one, prior_mean=[start], prior_cov=[wide], **noise)


def nile():
    flow = np.array(NILE.split(), dtype=float)
    held_out = flow[::-1] + 1.0
    runs = [{"measurements": one} for one in (flow, flow, held_out, held_out)]
    return RunsProblem(runs, level(), held_out=[2, 3], name="the Nile")


@pytest.mark.parametrize("method", slow_but(["likelihood", "em", "squarem", "scoring"], ["likelihood", "em"]))
def test_the_nile_has_the_variances_that_durbin_and_koopman_print(method):
    task = task_of(nile(), 1)
    find_method(method).run(method, task)
    found = task.best.model
    assert found["process_noise_cov"][0] == pytest.approx(1469.1, rel=2e-3)
    assert found["measurement_noise_cov"] == pytest.approx(15099, rel=2e-3)


def test_noise_estimation_is_the_covariance_of_what_the_equations_leave():
    problem = linear(runs=8, steps=200)
    task = task_of(problem, 8)
    find_method("noise-estimation").run("noise-estimation", task)
    data, model = task.data[0], problem.model()
    a, _, _, c, _ = model.matrices()
    w = (data.states[:, 1:] - data.states[:, :-1] @ a.T).reshape(-1, 2)
    v = (data.measurements - data.states @ c.T).reshape(-1, 2)
    np.testing.assert_allclose(task.best.model["process_noise_cov"], np.cov(w.T), rtol=1e-10)
    np.testing.assert_allclose(task.best.model["measurement_noise_cov"], np.cov(v.T), rtol=1e-10)
    assert np.diag(task.best.model["process_noise_cov"]) == pytest.approx(np.diag(Q), rel=0.15)
    assert task.runs == 8


def test_means_and_correlation_over_time_tell_a_wrong_model():
    right = estimated_from(linear(steps=400).model(), task_of(linear(steps=400)).data[0])
    assert abs(right.process_correlation).max() < 0.1 and abs(right.process_mean).max() < 0.05
    wrong = linear(a=np.array([[1.0, 0.1], [0.0, 0.6]]), steps=400).model()
    found = estimated_from(wrong, task_of(linear(steps=400)).data[0])
    assert found.process_correlation.max() > 0.3


def of_known_state(rows, seed, q):
    """A task on noise about a state that is known: of its model only R is free."""
    one, still = np.eye(1), {"prior_mean": [0.0], "prior_cov": [1e-14], "process_noise_cov": [q]}
    model = affine_model(a=one, b=np.zeros((1, 0)), c=one, measurement_noise_cov=2.0, **still)
    z = 1.3 * np.random.default_rng(seed).standard_normal((4, rows))
    problem = RunsProblem([{"measurements": run} for run in z], model, held_out=[2, 3], name="noise")
    return z[0], Task("kf", problem, problem.data([0]))


def test_map_of_noise_of_a_known_state_is_the_mode_of_an_inverse_wishart_distribution():
    z, task = of_known_state(12, 0, 1e-14)
    find_method("map").run("map", task)
    scale = task.start.model["measurement_noise_cov"]  # nu = 3: density r^(-5/2) exp(-scale / 2 r)
    expected = (scale + (z**2).sum()) / (z.size + 5)
    assert task.best.model["measurement_noise_cov"] == pytest.approx(expected, rel=1e-5)


def test_map_of_a_full_q_that_is_seen_is_the_mode_of_an_inverse_wishart_distribution():
    a, c, r = np.array([[0.9, 0.2], [0.0, 0.8]]), np.eye(2), 1e-10 * np.eye(2)
    q = np.array([[0.5, 0.2], [0.2, 0.3]])
    problem = linear(a=a, c=c, q=q, r=r, p0=np.eye(2), steps=20)
    task = task_of(problem, options={"full_q": True, "hold_r": True})
    find_method("map").run("map", task)
    z = task.data[0].measurements
    w = (z[:, 1:] - z[:, :-1] @ a.T).reshape(-1, 2)
    centre = task.model(task.start).process_noise_cov
    expected = (centre + w.T @ w) / (len(w) + 4 + 2 + 1)  # nu = n + 2
    np.testing.assert_allclose(task.best.model["process_noise_cov"], expected, rtol=1e-4)


@pytest.mark.parametrize("method", ["posterior", "nuts"])
def test_the_posterior_mean_is_that_of_an_integral_on_a_grid(method):
    if method == "nuts":
        pytest.importorskip("nutpie")
    z, task = of_known_state(8, 1, 0.0)
    assert [parameter.name for parameter in task.free] == ["R"]
    find_method(method).run(method, task)
    grid = np.linspace(-8.0, 8.0, 4001)
    log = -0.5 * (z.size * grid + (z**2).sum() * np.exp(-grid))
    log -= 0.5 * ((grid - np.log(2.0)) / np.log(10.0)) ** 2
    weights = np.exp(log - log.max())
    mean, second = ((weights * power).sum() / weights.sum() for power in (grid, grid**2))
    error = 4 * np.sqrt((second - mean**2) / 300)  # of 2000 draws, or 500, that go together over some steps
    assert np.log(task.best.model["measurement_noise_cov"]) == pytest.approx(mean, abs=error)


@pytest.mark.slow
def test_draws_by_gradients_have_the_mean_of_a_random_walk_and_end_with_the_budget():
    pytest.importorskip("nutpie")
    problem, found = linear(runs=4), {}
    for method in ("posterior", "nuts"):
        task = task_of(problem, 4)
        find_method(method).run(method, task)
        found[method] = np.log(task.values_of(task.best, task.free))
    np.testing.assert_allclose(found["nuts"], found["posterior"], atol=0.12)
    few = []
    for runs in (1, 300, 300):
        task = task_of(problem, 4, budget=Budget(runs=runs))
        task._prices[LIKELIHOOD] = 4.0  # which is measured by a clock otherwise
        find_method("nuts").run("nuts", task)
        assert task.runs <= runs + 4 * task._prices[LIKELIHOOD] and (len(task.answers) > 1) == (runs > 1)
        few.append(task.values_of(task.best, task.free))
    np.testing.assert_array_equal(few[1], few[2])


def test_methods_lack_nutpie_or_variances_in_one_line(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ValueError, match="method 'nuts' needs nutpie, which is not installed: pip install nutpie"):
        find_method("nuts").run("nuts", task_of(linear()))
    task = task_of(linear(), options={"prior": True})
    refused("EM tunes only variances in Q and R, but P0 is tuned, too", find_method("em").run, "em", task)


MOTIVATING = {  # of the ALS toolbox: Odelson, Rajamani, Rawlings
    "a": np.array([[0.1, 0.0, 0.1], [0.0, 0.2, 0.0], [0.0, 0.0, 0.3]]),
    "g": np.array([1.0, 2.0, 3.0]),
    "c": np.array([[0.1, 0.2, 0.0]]),
}


def motivating(q=0.2, r=0.4):
    """The example's model, at the Q and R of its first gain."""
    g = MOTIVATING["g"]
    start = {"x0": [10.0] * 3, "P0": [1e-12] * 3}
    return affine_model(A=MOTIVATING["a"], C=MOTIVATING["c"], Q=q * np.outer(g, g), R=r, **start)


@pytest.mark.slow
def test_als_has_the_scatter_of_the_toolboxs_example():
    free = [Parameter("q", 1e-6, 1e3, default=0.2), Parameter("r", 1e-6, 1e3, default=0.4)]
    truth = motivating(0.5, 0.1)
    problem = ModelProblem(truth, motivating, steps=1000, parameters=free, scale=(1.0,) * 3, name="motivating")
    found = []
    for repetition in range(30):
        task = Task("kf", problem, problem.data([repetition]))
        find_method("als").run("als", task)
        found.append([task.answers[1].choice.model[name] for name in ("q", "r")])  # with the gain of the example
    means, deviations = np.mean(found, axis=0), np.std(found, axis=0)
    errors = np.array([0.135, 0.033]) / np.sqrt(30)
    assert (abs(means - [0.495, 0.100]) < 4 * errors).all(), (means, deviations)
    np.testing.assert_allclose(deviations, [0.135, 0.033], rtol=0.4)


def test_lagged_covariances_are_those_of_many_innovations():
    model = motivating(0.5, 0.1)
    linear_model = stationary(model, "motivating", "als")
    gain = steady_gain(linear_model, 0.2 * np.outer(MOTIVATING["g"], MOTIVATING["g"]), np.array([[0.4]]))
    keys = np.array([[one, 7] for one in range(200)], dtype=np.uint32)
    z = simulate(model, keys, np.zeros((200, 1000, 0))).measurements
    mean, innovations = np.zeros((200, 3)) + 10.0, []
    for k in range(1000):
        e = z[:, k] - mean @ linear_model.c.T
        innovations.append(e)
        mean = (mean + e @ gain.T) @ linear_model.a.T
    runs = list(np.array(innovations).transpose(1, 0, 2)[:, 100:])
    expected = lagged(linear_model, gain, model.process_noise_cov, model.measurement_noise_cov, 5)
    np.testing.assert_allclose(autocovariances([runs], 5), expected, atol=4e-3 * expected[0, 0, 0] + 2e-3)


def test_mehra_finds_q_and_r_from_the_covariances_of_a_gain_that_is_not_the_best():
    linear_model = stationary(linear(a=A).model(), "a chain", "mehra")
    gain = steady_gain(linear_model, np.diag([0.5, 0.01]), np.diag([0.1, 2.0]))
    seen = lagged(linear_model, gain, Q, R, 6)
    q_units = np.array([np.diag([1.0, 0.0]), np.diag([0.0, 1.0]), np.zeros((2, 2))])
    r_units = np.array([np.zeros((2, 2)), np.zeros((2, 2)), np.diag([1.0, 0.0])])
    noise = Noise(q_units, r_units, (np.zeros((2, 2)), np.diag([0.0, R[1, 1]])))
    matrix, right = mehra_equations(linear_model, gain, seen, noise)
    np.testing.assert_allclose(matrix @ [Q[0, 0], Q[1, 1], R[0, 0]], right, atol=1e-10)
    assert np.linalg.matrix_rank(matrix) == 3


@pytest.mark.slow
def test_mehra_scatters_more_than_als():
    problem, found = linear(a=A, steps=400, runs=40), {"mehra": [], "als": []}
    truth = np.array([Q[0, 0], Q[1, 1], R[0, 0], R[1, 1]])
    for place in range(40):
        for method, values in found.items():
            task = Task("kf", problem, problem.data([place]))
            find_method(method).run(method, task)
            values.append(task.values_of(task.best, task.free))
    means = {method: np.mean(values, axis=0) for method, values in found.items()}
    errors = {method: np.std(values, axis=0) for method, values in found.items()}
    for method in found:
        assert (abs(means[method] - truth) < 4 * errors[method] / np.sqrt(40)).all(), (method, means[method])
    ratios = errors["mehra"] / errors["als"]
    assert ratios.max() > 1.3 and ratios.min() > 0.9, ratios


FULL_Q, FULL_R = np.array([[0.05, 0.06], [0.06, 0.2]]), np.array([[0.4, -0.1], [-0.1, 0.1]])
WHOLE = np.tril(np.ones((2, 2), dtype=bool)), np.tril(np.ones((2, 2), dtype=bool))
OTHER = np.diag([0.5, 0.01]), np.diag([0.1, 2.0])  # where searches begin


def test_als_finds_full_matrices_from_the_covariances_of_a_gain_that_is_not_the_best():
    model = stationary(linear(a=A).model(), "a chain", "als")
    gain = steady_gain(model, *OTHER)
    q, r = semidefinite(model, gain, lagged(model, gain, FULL_Q, FULL_R, 8), OTHER, WHOLE)
    np.testing.assert_allclose(q, FULL_Q, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(r, FULL_R, rtol=1e-6, atol=1e-8)
    with_r = WHOLE[0], np.zeros((2, 2), dtype=bool)
    q, r = semidefinite(model, gain, lagged(model, gain, FULL_Q, FULL_R, 8), (OTHER[0], FULL_R), with_r)
    np.testing.assert_allclose(q, FULL_Q, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(r, FULL_R, rtol=1e-9)


def test_semidefinite_least_squares_have_the_optimality_of_convex_programs():
    model = stationary(linear(a=A).model(), "a chain", "als")
    gain, units = steady_gain(model, *OTHER), symmetric_units(2)
    outside = lagged(model, gain, np.array([[0.05, 0.15], [0.15, 0.2]]), FULL_R, 8)  # of a Q that is none
    outside += 0.02 * np.random.default_rng(0).standard_normal(outside.shape)
    q, r = semidefinite(model, gain, outside, OTHER, WHOLE)
    left = lagged(model, gain, q, r, 8) - outside
    none, floor = np.zeros((2, 2)), 1e-6 * (left**2).sum()
    for cov, side in ((q, 0), (r, 1)):
        by = [(left * lagged(model, gain, *((one, none) if side == 0 else (none, one)), 8)).sum() for one in units]
        slope = 0.5 * (np.tensordot(by, units, 1) + np.diag(np.diag(np.tensordot(by, units, 1))))
        assert np.linalg.eigvalsh(cov)[0] > 0.0
        assert np.linalg.eigvalsh(slope)[0] > -floor and abs(np.trace(slope @ cov)) < floor
    assert np.linalg.eigvalsh(q)[0] < 1e-8  # at the end of what may be


def test_als_finds_full_matrices_of_long_runs():
    problem = linear(q=FULL_Q, r=FULL_R, steps=4000, runs=8)
    task = task_of(problem, 8, options={"full_q": True, "full_r": True})
    task.start = at(task, np.diag(OTHER[0]), np.diag(OTHER[1]))
    find_method("als").run("als", task)
    np.testing.assert_allclose(task.best.model["process_noise_cov"], FULL_Q, rtol=0.1)
    np.testing.assert_allclose(task.best.model["measurement_noise_cov"], FULL_R, rtol=0.1)
    assert task.runs == 3 * 8


@pytest.mark.slow
def test_fisher_scoring_ends_where_l_bfgs_ends():
    problem = linear(runs=4, steps=80)
    tasks = {method: task_of(problem, 4, options={"full_q": True}) for method in ("scoring", "likelihood")}
    for method, task in tasks.items():
        find_method(method).run(method, task)
    by_scoring, by_l_bfgs = (task.value(task.best, LIKELIHOOD) for task in tasks.values())
    assert by_scoring == pytest.approx(by_l_bfgs, rel=1e-8)
    assert len(tasks["scoring"].answers) < len(tasks["likelihood"].answers)


@pytest.mark.parametrize(
    ("method", "filter_name", "options", "rule"),
    [
        ("als", "kf", {"prior": True}, "method 'als' must come without prior"),
        ("mehra", "kf", {"full_q": True}, "method 'mehra' must come without full_q"),
        ("anderson", "kf", {}, "method 'anderson' tunes the inflation of an ensemble, but 'kf' has none"),
        ("posterior", "enkf", {"hold_r": True}, "'posterior' tunes the model, but .* has no free parameter"),
    ],
)
def test_what_a_method_cannot_do_is_said_in_a_line(method, filter_name, options, rule):
    problem = ring(steps=4) if filter_name == "enkf" else linear()
    task = Task(filter_name, problem, problem.data(range(2)), options=options)
    refused(rule, find_method(method).run, method, task)


def test_runs_are_counted_and_end_a_method():
    task = task_of(linear(), budget=Budget(runs=40))
    find_method("random-only").run("random-only", task)
    assert task.runs == 44 and task.answers[-1].runs <= 40  # the evaluation that went beyond is not taken
    assert task.best_within(runs=0) == task.start
    assert [one.runs for one in task.answers] == sorted(one.runs for one in task.answers)


def test_the_level_of_inflation_is_the_mode_of_its_density():
    for square, spread in ((9.0, 0.3), (0.01, 0.1), (1.5, 0.6)):
        found, deviation = updated(1.2, spread, square, 0.8, 0.4)
        grid = np.linspace(0.2, 4.0, 400_001)
        total = grid * 0.8 + 0.4
        log = -0.5 * ((grid - 1.2) / spread) ** 2 - 0.5 * np.log(total) - 0.5 * square / total
        assert found == pytest.approx(grid[log.argmax()], abs=1e-4)
        assert 0.02 <= deviation <= spread


def test_innovations_ask_for_inflation_where_the_spread_is_too_small():
    found = {}
    for name, part in (("right", 1.0), ("small", 0.25)):
        problem = linear(steps=200, runs=6)
        plain = task_of(problem, 6, "enkf")
        start = at(plain, part * np.diag(Q), np.diag(R)).with_size(60)
        task = task_of(problem, 6, "enkf", start=start)
        find_method("anderson").run("anderson", task)
        found[name] = task.best.numbers["inflation"]
        assert task.runs == 6 and task.best.model == start.model
    assert 1.0 <= found["right"] < 1.03 < found["small"] - 0.03


FIRST_Q, FIRST_R = np.array([0.5, 0.02]), np.array([0.1, 0.6])


def smoothed(z, q, r):
    """Means, covariances and lag-one covariances given all measurements of a run, by Rauch, Tung and Striebel."""
    mean, cov, filtered, predicted = np.zeros(2), P0, [], []
    for k, row in enumerate(z):
        if k:
            mean, cov = A @ mean, A @ cov @ A.T + q
        predicted.append((mean, cov))
        there = ~np.isnan(row)
        h, noise = C[there], r[np.ix_(there, there)]
        gain = cov @ h.T @ np.linalg.inv(h @ cov @ h.T + noise)
        mean, cov = mean + gain @ (row[there] - h @ mean), cov - gain @ h @ cov
        filtered.append((mean, cov))
    means, covs, lags = [filtered[-1][0]], [filtered[-1][1]], []
    for k in range(len(z) - 2, -1, -1):
        back = filtered[k][1] @ A.T @ np.linalg.inv(predicted[k + 1][1])
        lags.insert(0, covs[0] @ back.T)  # cov(x_{k+1}, x_k)
        covs.insert(0, filtered[k][1] + back @ (covs[0] - predicted[k + 1][1]) @ back.T)
        means.insert(0, filtered[k][0] + back @ (means[0] - predicted[k + 1][0]))
    return means, covs, lags


def textbook_step(runs, q, r):
    """Q and R after one step of EM, full; a channel that was missed is left out of its own mean."""
    of_q, of_r, transitions, measured = np.zeros((2, 2)), np.zeros((2, 2)), 0, np.zeros((2, 2))
    for z in runs:
        means, covs, lags = smoothed(z, q, r)
        for k in range(len(z)):
            there = ~np.isnan(z[k])
            left = np.where(there, z[k] - C @ means[k], 0.0)
            both = np.outer(there, there)
            of_r += both * (np.outer(left, left) + C @ covs[k] @ C.T)
            measured += both
            if k:
                w = means[k] - A @ means[k - 1]
                lag = lags[k - 1] @ A.T
                of_q += np.outer(w, w) + covs[k] + A @ covs[k - 1] @ A.T - lag - lag.T
                transitions += 1
    return of_q / transitions, of_r / measured


@pytest.mark.parametrize("missing", [0.0, 0.2])
def test_a_step_of_diagonals_is_a_smoothers(missing):
    problem = linear(missing=missing)
    task = task_of(problem, budget=Budget(runs=9.0))
    task.start = at(task, FIRST_Q, FIRST_R)
    goal = task.goal(LIKELIHOOD, keeps=False)
    found = goal(goal.coordinates.of(goal.untuned))
    transitions, measured, _ = counts_of(task)
    slopes = found.gradient
    q = FIRST_Q * (1 + 2 / transitions * slopes[:2])
    r = FIRST_R * (1 + 2 / measured * slopes[2:])
    expected = textbook_step(task.data[0].measurements, np.diag(FIRST_Q), np.diag(FIRST_R))
    np.testing.assert_allclose(q, np.diag(expected[0]), rtol=1e-9)
    np.testing.assert_allclose(r, np.diag(expected[1]), rtol=1e-9)


@pytest.mark.parametrize("full", [False, True])
def test_the_method_goes_these_steps(full):
    problem = linear()
    task = task_of(problem, options={"full_q": full, "full_r": full})
    task.start = at(task, FIRST_Q, FIRST_R)
    with pytest.raises(StopIteration):
        _second_choice(task, "em")
    q, r = np.diag(FIRST_Q), np.diag(FIRST_R)
    for answer in task.answers[2:5]:
        q, r = textbook_step(task.data[0].measurements, q, r)
        if not full:
            q, r = (np.diag(np.diag(one)) for one in (q, r))
        model = answer.choice.filter(problem).model
        np.testing.assert_allclose(model.process_noise_cov, q, rtol=1e-8)
        np.testing.assert_allclose(model.measurement_noise_cov, r, rtol=1e-8)


def _second_choice(task, name):
    """Stop a method once it has kept five choices."""
    keep = task.keep

    def counted(choice):
        keep(choice)
        if len(task.answers) > 5:
            raise StopIteration

    task.keep = counted
    find_method(name).run(name, task)


@pytest.mark.parametrize("name, options", [("em", {}), ("squarem", {}), ("em", {"full_q": True, "full_r": True})])
def test_em_ends_where_the_gradient_of_the_likelihood_ends(name, options):
    problem, levels = linear(runs=6, steps=80), []
    for method in (name, LIKELIHOOD):
        task = task_of(problem, 6, options=options)
        find_method(method).run(method, task)
        levels.append(values_of(task.best.filter(problem), task.data[0], problem.scale).log_likelihood)
    assert levels[0] == pytest.approx(levels[1], rel=1e-6)
