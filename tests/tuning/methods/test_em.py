"""EM by slopes against the sums of squares of a smoother, as textbooks have them, and against the likelihood."""

import numpy as np
import pytest

from tests.tuning.methods.problems import P0, A, C, at, linear, task_of
from tuning.evaluation.evaluate import values_of
from tuning.methods.gradients import counts_of
from tuning.methods.task import Budget, find_method
from tuning.search.plan import LIKELIHOOD

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


def test_the_method_goes_these_steps():
    task = task_of(linear())
    task.start = at(task, FIRST_Q, FIRST_R)
    with pytest.raises(StopIteration):
        _second_choice(task, "em")
    q, r = np.diag(FIRST_Q), np.diag(FIRST_R)
    for answer in task.answers[2:5]:
        q, r = (np.diag(np.diag(one)) for one in textbook_step(task.data[0].measurements, q, r))
        np.testing.assert_allclose(answer.choice.model["process_noise_cov"], np.diag(q), rtol=1e-8)
        np.testing.assert_allclose(answer.choice.model["measurement_noise_cov"], np.diag(r), rtol=1e-8)


def test_the_method_goes_these_steps_with_full_matrices():
    task = task_of(linear(), options={"full_q": True, "full_r": True})
    task.start = at(task, FIRST_Q, FIRST_R)
    with pytest.raises(StopIteration):
        _second_choice(task, "em")
    q, r = np.diag(FIRST_Q), np.diag(FIRST_R)
    for answer in task.answers[2:5]:
        q, r = textbook_step(task.data[0].measurements, q, r)
        np.testing.assert_allclose(answer.choice.model["process_noise_cov"], q, rtol=1e-8)
        np.testing.assert_allclose(answer.choice.model["measurement_noise_cov"], r, rtol=1e-8)


def _second_choice(task, name):
    """Stop a method once it has kept five choices."""
    keep = task.keep

    def counted(choice):
        keep(choice)
        if len(task.answers) > 5:
            raise StopIteration

    task.keep = counted
    find_method(name).run(name, task)


@pytest.mark.parametrize(
    ("name", "options"), [("em", {}), ("squarem", {}), ("em", {"full_q": True, "full_r": True})]
)
def test_em_ends_where_the_gradient_of_the_likelihood_ends(name, options):
    problem, levels = linear(runs=6, steps=80), []
    for method in (name, LIKELIHOOD):
        task = task_of(problem, 6, options=options)
        find_method(method).run(method, task)
        levels.append(values_of(task.best.filter(problem), task.data[0], problem.scale).log_likelihood)
    assert levels[0] == pytest.approx(levels[1], rel=1e-6)


def test_em_refuses_numbers_that_are_no_variances():
    task = task_of(linear(), options={"prior": True})
    with pytest.raises(ValueError, match="EM tunes only variances in Q and R, but P0 is tuned, too"):
        find_method("em").run("em", task)
