"""Where the start-up counts, P_0 is felt, searched and kept."""

import gymnasium as gym
import numpy as np
import optuna
import pytest

import thruster_env  # noqa: F401 - registers the env
from filters import EstimateState
from tests.filters.checks import refused
from thruster_env.thruster.model import thruster_model
from tuning.evaluation.evaluate import evaluate
from tuning.evaluation.held_out import evaluate_held_out
from tuning.evaluation.tuned import read_tuned, write_tuned
from tuning.plants.thruster import find_scenario
from tuning.problems.data import checked_first_scored_step
from tuning.search.among_types import RESCALED
from tuning.search.parameters import PRIOR_FACTORS
from tuning.search.plan import Plan
from tuning.search.space import untuned_choice
from tuning.search.study import open_study, run_study

STARTUP, NOMINAL = find_scenario("startup"), find_scenario("nominal")
PLAN = Plan("ekf", (STARTUP,))


@pytest.fixture(autouse=True)
def quiet():
    optuna.logging.set_verbosity(optuna.logging.WARNING)


def with_prior(factor, name="ekf", scenario=STARTUP):
    choice = untuned_choice(name, scenario)
    return choice._replace(model={**choice.model, "prior_cov_factor": factor})


def test_p0_is_that_of_the_plant_times_a_factor():
    model = thruster_model(prior_cov_factor=4.0)
    np.testing.assert_array_equal(model.prior_cov, 4.0 * thruster_model().prior_cov)
    np.testing.assert_array_equal(with_prior(0.1).filter(STARTUP).model.prior_cov, np.diag([1e3, 0.4]))
    refused("prior_cov_factor must be positive, but got 0", thruster_model, prior_cov_factor=0)


def test_the_score_feels_p0_where_the_start_up_counts_and_hardly_elsewhere():
    def ratio(scenario):
        data = scenario.data(range(16))
        scores = [
            evaluate(with_prior(factor, "ukf", scenario).filter(scenario), data, scenario.scale).score.value
            for factor in (1e-3, 1.0)
        ]
        return scores[0] / scores[1]

    assert ratio(STARTUP) > 1.2 and abs(ratio(STARTUP.replace(first_scored_step=50)) - 1) < 0.1


def test_errors_count_from_the_scenario_s_first_scored_step_on():
    late = STARTUP.replace(first_scored_step=50)
    choice, data, others = untuned_choice("ekf", STARTUP), STARTUP.data(range(4)), late.data(range(4))
    np.testing.assert_array_equal(data.states, others.states)
    whole, part = (evaluate(choice.filter(STARTUP), one, (1.0, 1.0)) for one in (data, others))
    # 501 steps are 50 of the start-up and 451 others
    pooled = (50 * whole.start_up_rmse**2 + 451 * part.mean_squares.mean(axis=0)) / 501
    np.testing.assert_allclose(whole.mean_squares.mean(axis=0), pooled, rtol=1e-12)
    np.testing.assert_array_equal(whole.start_up_rmse, part.start_up_rmse)
    for wrong in (-1, 500):
        refused("first_scored_step must be ", STARTUP.replace, first_scored_step=wrong)
    rule = "at most 499 in runs of 500 steps, but got 500: pass first_scored_step=0 "
    refused(rule, checked_first_scored_step, 500, 500)
    assert checked_first_scored_step(499, 500) == 499


def test_p0_is_searched_there_and_only_there():
    assert "P0" in PLAN.space() and "P0" not in Plan("ekf", (NOMINAL,)).space()
    assert "P0" in Plan("ekf", (NOMINAL, STARTUP)).space() and "P0" not in Plan("low-pass", (STARTUP,)).space()


@pytest.mark.slow
def test_a_study_tunes_p0_and_the_number_survives(tmp_path):
    result = run_study(open_study("s", PLAN, optuna.storages.InMemoryStorage()), PLAN, 40)
    assert result.trials[0].params["P0"] == 1.0
    factor = result.choice.model["prior_cov_factor"]
    assert factor < 0.5  # an EKF that starts blind should not trust what a wide prior makes of the first thrust
    assert result.best_value < 0.9 * result.trials[0].values[0]
    for rescaled in (trial for trial in result.trials if RESCALED in trial.user_attrs and "P0" in trial.params):
        trial = result.trials[rescaled.user_attrs[f"{RESCALED} of"]]
        factor_of_rescaled = rescaled.params["R"] / trial.params["R"]
        wanted = np.clip(factor_of_rescaled * trial.params["P0"], *PRIOR_FACTORS)  # its range
        assert rescaled.params["P0"] == pytest.approx(wanted, rel=1e-6)
    path = tmp_path / "t.json"
    write_tuned(path, PLAN, result, [evaluate_held_out(result.choice, STARTUP, 0, 4)], "s")
    assert read_tuned(path) == (result.choice, STARTUP, 0)
    env = gym.make("BowThruster-v0", initial_state={"mean": [0.0, 0.0], "cov": [[1e4, 0.0], [0.0, 4.0]]})
    env = EstimateState(env, tuned=str(path))
    np.testing.assert_allclose(env.filter.model.prior_cov, factor * np.diag([1e4, 4.0]))
