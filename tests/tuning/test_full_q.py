"""A full Q: positive definite by construction, searched, and read back wherever a tuned file is."""

import json

import gymnasium as gym
import numpy as np
import optuna
import pytest

import thruster_env  # noqa: F401 - registers the env
import tuning
from filters import EstimateState
from filters.tuned_file import read_tuned_file, sealed
from tuning.api.verify import verify
from tuning.evaluation.held_out import evaluate_held_out
from tuning.evaluation.tuned import read_tuned, write_tuned
from tuning.plants.thruster import find_scenario
from tuning.reporting.tables import choice_table
from tuning.search.among_types import RESCALED
from tuning.search.parameters import correlation_slopes, correlations_of, full_covariance
from tuning.search.plan import Plan
from tuning.search.space import choice_of, parameters_of, trial_parameters, untuned_choice
from tuning.search.study import open_study, run_study

MISMATCH = find_scenario("mismatch")
PLAN = Plan("ekf", (MISMATCH,), full_q=True)


def test_for_two_states_the_number_is_the_correlation_with_its_sign():
    cov = full_covariance((4.0, 9.0), [-0.5])
    np.testing.assert_allclose(cov, [[4.0, -3.0], [-3.0, 9.0]], rtol=1e-15)
    assert (full_covariance((4.0, 9.0), [0.0]) == np.diag([4.0, 9.0])).all()


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


def test_the_last_of_three_is_the_correlation_once_the_first_state_is_known():
    cov = full_covariance((1.0, 2.0, 3.0), [0.3, -0.6, 0.7])
    known = cov[1:, 1:] - np.outer(cov[1:, 0], cov[0, 1:]) / cov[0, 0]
    assert known[0, 1] / np.sqrt(known[0, 0] * known[1, 1]) == pytest.approx(0.7)


def test_a_state_without_noise_has_neither_variance_nor_covariances():
    cov = full_covariance((1.0, 0.0, 4.0), [0.3, 0.5, -0.2])
    assert (cov[1] == 0.0).all() and cov[0, 2] == pytest.approx(0.5 * 2.0)


@pytest.mark.parametrize(
    ("arguments", "rule"),
    [
        (((1.0, -1.0), [0.1]), "variances must be at least zero, but got"),
        (((1.0, 1.0), [1.01]), "correlations must be 1 numbers from -1 to 1"),
        (((1.0, 1.0), []), "correlations must be 1 numbers from -1 to 1"),
    ],
)
def test_other_numbers_are_refused(arguments, rule):
    with pytest.raises(ValueError, match=rule):
        full_covariance(*arguments)


def test_a_choice_with_a_full_q_survives_its_trial_parameters():
    choice = untuned_choice("enkf", MISMATCH)
    q = tuple(map(tuple, full_covariance(choice.model["process_noise_cov"], [0.4]).tolist()))
    choice = choice._replace(model={**choice.model, "process_noise_cov": q})
    parameters = parameters_of(choice)
    assert parameters["correlation_12"] == pytest.approx(0.4)
    again = choice_of("enkf", parameters, MISMATCH)
    np.testing.assert_allclose(again.model["process_noise_cov"], q, rtol=1e-12)
    np.testing.assert_array_equal(choice.filter(MISMATCH).model.process_noise_cov, q)
    assert trial_parameters(untuned_choice("enkf", MISMATCH), PLAN.space())["correlation_12"] == 0.0


def test_a_study_of_a_full_q_ends_in_a_file_that_everything_reads(tmp_path):
    result = run_study(open_study("s", PLAN, optuna.storages.InMemoryStorage()), PLAN, 14)
    q = np.array(result.choice.model["process_noise_cov"])
    assert q.shape == (2, 2) and q[0, 1] == q[1, 0] != 0.0
    path = tmp_path / "t.json"
    write_tuned(path, PLAN, result, [evaluate_held_out(result.choice, MISMATCH, 0, 4)], "s")
    assert read_tuned(path) == (result.choice, MISMATCH, 0) and verify(path).holds
    env = EstimateState(gym.make("BowThruster-v0"), tuned=str(path))
    np.testing.assert_array_equal(env.filter.model.process_noise_cov, q)
    shown = choice_table({"untuned": untuned_choice("ekf", MISMATCH), "tuned": result.choice}, MISMATCH)
    assert "correlation 12" in [row[0] for row in shown.rows]

    content = read_tuned_file(path)
    content["filter"]["model"]["process_noise_cov"][0][1] *= -1
    path.write_text(json.dumps(sealed(content)))
    with pytest.raises(ValueError, match="process_noise_cov must be 2 variances or a symmetric 2 x 2 matrix"):
        read_tuned(path)


def test_a_consistent_twin_has_the_same_correlation():
    result = run_study(open_study("s", PLAN, optuna.storages.InMemoryStorage()), PLAN, 12)
    twins = [trial for trial in result.trials if RESCALED in trial.user_attrs and "R" in trial.params]
    assert twins
    for rescaled in twins:
        trial = result.trials[rescaled.user_attrs[f"{RESCALED} of"]]
        assert rescaled.params["correlation_12"] == trial.params["correlation_12"]
        assert rescaled.params["R"] / trial.params["R"] == pytest.approx(
            rescaled.params["Q11"] / trial.params["Q11"]
        )


def test_the_gradient_refuses_a_budget_with_one_clear_line():
    with pytest.raises(ValueError, match="must come without a budget, but got budget"):
        tuning.tune("mismatch", "ekf", budget=1.0, method="gradient")


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
