"""A state-space model as a Gymnasium env, and filters around it."""

import json
import math
import os
import pickle
import subprocess
import sys
import threading
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from filters import EstimateState
from tests.models import lonely_model, plane_model, state_space
from thruster_env.core.compiled import interpreted
from thruster_env.core.streams import episode_keys
from thruster_env.env.model_env import ModelEnv, ModelVectorEnv, page_of
from thruster_env.graphs.values import traceable
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
    close = {"rtol": 1e-13, "atol": 1e-14}  # sums of the same terms in another order
    np.testing.assert_allclose([info["state"] for info in found], truth.states[0], **close)
    np.testing.assert_allclose([info["measurement"] for info in found], truth.measurements[0], **close)
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
        (
            {"disturbances": {"u_1": [{"name": "gauss-markov", "std": 1.0, "time_constant": 1.0}]}},
            r"dt must be given, the sample time \[s\], where effects depend on it, but it is None",
        ),
    ],
)
def test_a_wrong_argument_is_refused(arguments, rule):
    with pytest.raises(ValueError, match=rule):
        ModelEnv(**{"truth": plane_model(), **arguments})


def test_a_wrong_action_is_refused():
    env = ModelEnv(plane_model())
    env.reset(seed=0)
    with pytest.raises(ValueError, match="an action must be one .* and not NaN"):
        env.step([np.nan])


def deciding(x, u, c):
    steps = 0.0
    while steps < x[0]:  # cannot be traced
        steps += 1.0
    return (0.9 * x[0] + u[0] - 0.1 * steps,)


def linear(x, u, c):
    return (0.9 * x[0] + u[0],)


def level(x, c):
    return (x[0],)


def reward(x, u):
    return -(x[0] * x[0]) - 0.1 * u[0] * u[0]


def ends(x):
    return abs(x[0]) > 4.0


def one_state(transition):
    names = {"states": [("level", "h", "m")], "input_quantities": [("flow", "q", "m/s")]}
    noise = {"q": [0.04], "r": [0.01], "mean": [1.0], "cov": [1.0]}
    return state_space(transition, level, **noise, inputs=1, measurements=[("pressure", "p", "m")], **names)


@pytest.mark.parametrize("transition", [linear, deciding])
def test_a_model_that_can_only_be_called_is_simulated_too(transition):
    model, inputs = one_state(transition), np.array([[[0.5], [-1.0], [2.0]]])
    truth, env = simulate(model, episode_keys([7]), inputs), ModelEnv(model)
    found = [env.reset(seed=7)[1], *(env.step(u)[4] for u in inputs[0])]
    np.testing.assert_allclose([info["state"] for info in found], truth.states[0], rtol=1e-13)


def catching(x, u, c):
    try:
        inverse = 1.0 / u[0]
    except ZeroDivisionError:
        inverse = 0.0
    return (0.9 * x[0] + 0.1 * inverse,)


class Deciding:
    """A model's f that is an object."""

    def __call__(self, x, u, c):
        """The next state."""
        return deciding(x, u, c)


def states_and_warnings(transition) -> tuple[list[float], list[str]]:
    """States of an episode, and what is said of the model."""
    env = ModelEnv(one_state(transition))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        infos = [env.reset(seed=7)[1], *(env.step([u])[4] for u in (0.5, 0.0, 2.0))]
    return [float(info["state"][0]) for info in infos], [str(warning.message) for warning in caught]


FIRST_USE = """
import json
from tests.thruster_env.env.test_model_env import Deciding, catching, deciding, states_and_warnings
print(json.dumps([states_and_warnings(f) for f in (deciding, catching, Deciding())]))
"""


def test_an_env_is_the_first_use_of_a_model_that_can_only_be_called(tmp_path):
    here = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path), "NUMBA_DISABLE_JIT": "0"}
    command = [sys.executable, "-c", FIRST_USE]
    printed = subprocess.run(command, env=here, capture_output=True, text=True, check=True).stdout
    compiled, *as_python = json.loads(printed)
    for (states, said), transition in zip((compiled, *as_python), (deciding, catching, Deciding()), strict=True):
        np.testing.assert_allclose(states, states_and_warnings(transition)[0], rtol=1e-13)
        assert len(said) == (transition is not deciding) and all("runs as Python" in text for text in said)


def test_models_of_equal_code_have_their_own_functions():
    def of(gains):
        def transition(x, u, c):
            steps = 0.0
            while steps < abs(x[0]):  # cannot be traced
                steps += 1.0
            return (gains["decay"] * x[0] + 0.0 * steps + u[0],)

        return transition

    envs = [ModelEnv(one_state(of({"decay": decay}))) for decay in (0.9, -0.9)]
    before = [env.reset(seed=7)[1]["state"][0] for env in envs]
    after = [env.step([0.0])[4]["state"][0] for env in envs]  # with equal noise
    assert before[0] == before[1] and after[0] - after[1] == pytest.approx(1.8 * before[0])


def test_a_model_without_value_at_some_points_is_traced_all_the_same():
    env = ModelEnv(one_state(lambda x, u, c: (math.sqrt(x[0] - 0.7),)))
    assert page_of(env.plant, env.task)[1].table is None  # no constants for a function that is called


def test_a_traced_function_takes_floats_in_a_thread_that_has_traced_nothing():
    def larger(x, y):
        return x if x > y else y

    results = []
    function = traceable(lambda x: 2.0 * larger(x, 1.0))
    thread = threading.Thread(target=lambda: results.append(function(3.0)))
    thread.start()
    thread.join()
    assert results == [6.0]


def reward_of_positive(x, u):
    if x[0] > 0.0:
        return x[0]
    raise ValueError("a negative state")


def test_a_reward_is_nan_where_it_raises():
    env = ModelEnv(one_state(linear), reward=reward_of_positive)
    env.reset(seed=1)
    for action in (3.0, -30.0):
        _, reward_, _, _, info = env.step([action])
        assert reward_ == info["state"] if action > 0.0 else np.isnan(reward_)


def test_copies_are_single_envs_with_all_disturbances_and_a_task():
    arguments = {
        "truth": one_state(linear),
        "low": -2.0,
        "high": 2.0,
        "dt": 0.1,
        "sensors": {"p": [{"name": "outliers", "std": 1.0, "probability": 0.3}, {"name": "dropout"}]},
        "disturbances": {"q": [{"name": "constant", "value": 0.25}]},
        "reward": reward,
        "ends": ends,
    }
    copies, envs = ModelVectorEnv(3, **arguments), [ModelEnv(**arguments) for _ in range(3)]
    rows = copies.reset(seed=4)[0]
    for i, env in enumerate(envs):
        np.testing.assert_allclose(env.reset(seed=4 + i)[0], rows[i], rtol=1e-12)
    for k in range(15):
        before = [env.unwrapped._report[env.report_rows.info["state"]].copy() for env in envs]
        rows, rewards, ended, _, infos = copies.step(np.full((3, 1), 3.0))
        for i, env in enumerate(envs):
            observation, reward_, end, _, info = env.step([3.0])
            assert rows.dtype == observation.dtype == np.float64
            np.testing.assert_allclose(rows[i], observation, rtol=1e-12)
            assert (rewards[i], ended[i]) == (pytest.approx(reward_), end)
            assert reward_ == pytest.approx(reward(info["state"], [2.0])) and end == ends(info["state"])
            noise = info["state"] - (0.9 * before[i] + 2.25)  # clipped, then disturbed
            assert abs(noise) < 1.0 and infos["measurement_valid"][i] == info["measurement_valid"]
        if ended.any():
            assert k > 0
            break
    assert copies.state_space_model().n == 1
