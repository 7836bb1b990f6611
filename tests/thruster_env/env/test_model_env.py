"""A state-space model as a Gymnasium env, and filters around it."""

import pickle

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from filters import EstimateState
from tests.models import lonely_model, plane_model
from thruster_env.core.compiled import interpreted
from thruster_env.core.streams import episode_keys
from thruster_env.env.model_env import ModelEnv
from thruster_env.model.simulate import simulate
from tuning.experiments import range_bearing


@pytest.fixture(autouse=True)
def as_python():
    with interpreted():
        yield


def test_an_episode_is_what_is_simulated_for_its_seed():
    model, inputs = plane_model(), np.array([[[0.5], [-1.0], [2.0]]])
    truth, env = simulate(model, episode_keys([7]), inputs), ModelEnv(model, low=-3.0, high=3.0)
    found = [env.reset(seed=7)[1], *(env.step(u)[4] for u in inputs[0])]
    np.testing.assert_array_equal([info["state"] for info in found], truth.states[0])
    np.testing.assert_array_equal([info["measurement"] for info in found], truth.measurements[0])
    env.reset(seed=7)
    np.testing.assert_array_equal(env.step([9.0])[4]["state"], (env.reset(seed=7), env.step([3.0])[4]["state"])[1])


def test_it_keeps_to_gymnasium_s_rules_with_inputs_and_without():
    check_env(ModelEnv(plane_model(), low=-1.0, high=1.0), skip_render_check=True)
    env = EstimateState(gym.wrappers.TimeLimit(ModelEnv(lonely_model()), 3), filter="ekf")
    env.reset(seed=1)
    ends = [env.step(np.empty(0))[3] for _ in range(3)]
    assert ends == [False, False, True]


def test_filters_find_what_they_may_assume():
    env = range_bearing.problem.env()
    assert env.state_space_model(sigma_a=1.0).process_noise_cov[1, 1] == pytest.approx(range_bearing.DT)
    plain, copy = EstimateState(env, filter="ekf"), pickle.loads(pickle.dumps(env))
    assert plain.filter.model.process_noise_cov[1, 1] == pytest.approx(range_bearing.SIGMA.start**2)
    np.testing.assert_array_equal(copy.reset(seed=2)[0], env.reset(seed=2)[0])
    factor = {"prior_cov_factor": 4.0}
    grown = EstimateState(ModelEnv(plane_model()), filter="ekf", model_arguments=factor).filter.model
    np.testing.assert_allclose(grown.prior_cov, 4.0 * plane_model().prior_cov)


@pytest.mark.parametrize(
    ("arguments", "rule"),
    [
        ({"truth": "a model"}, "the truth of an env must be a StateSpaceModel, but it is 'a model'"),
        ({"low": 2.0, "high": 1.0}, "low and high must be one number or 1, low at most high"),
        ({"low": [0.0, 1.0]}, "low and high must be one number or 1"),
        ({"dt": -1.0}, "dt must be positive, but got -1"),
    ],
)
def test_a_wrong_argument_is_refused(arguments, rule):
    with pytest.raises(ValueError, match=rule):
        ModelEnv(**{"truth": plane_model(), **arguments})


def test_a_wrong_action_is_refused():
    env = ModelEnv(plane_model())
    env.reset(seed=0)
    with pytest.raises(ValueError, match="an action must be 1 numbers and not NaN"):
        env.step([np.nan])
