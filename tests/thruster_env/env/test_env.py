"""The mechanics of an env, on a plant that is no thruster: three states, two inputs, two channels."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from tests.small_plant import INPUTS, CartEnv, CartVectorEnv
from tests.thruster_env.thruster.test_vector_env import (
    assert_copies_are_single_envs,
    every_mode,
)
from thruster_env.core.streams import draw_key
from thruster_env.model.simulate import simulate

LOSING = {
    "sensors": {"speed": [{"name": "dropout", "probability": 0.3}], "position": [{"name": "delay", "steps": 2}]}
}
ACTION = np.array([1.0, -0.2])
as_python = pytest.mark.usefixtures("as_python")


@pytest.fixture(autouse=True, scope="module")
def registered():
    home = "tests.small_plant"
    entries = {"entry_point": f"{home}:CartEnv", "vector_entry_point": f"{home}:CartVectorEnv"}
    gym.register("Cart-v0", **entries, max_episode_steps=7)
    yield
    del gym.registry["Cart-v0"]


@as_python
def test_gymnasium_accepts_the_env():
    check_env(CartEnv(**LOSING), skip_render_check=True)
    env = gym.make("Cart-v0", **LOSING)
    assert env.observation_space.shape == (4,) and env.unwrapped.appended_entries == 2
    assert env.action_space.shape == (len(INPUTS),)


@as_python
def test_truth_is_that_of_the_model_with_the_same_key():
    env = CartEnv()
    generator = np.random.default_rng(np.random.SeedSequence(5))
    key = draw_key(gym.utils.seeding.np_random(5)[0])
    actions = generator.uniform(-1, 1, (1, 9, 2))
    expected = simulate(env.state_space_model(), key[None], actions)
    _, info = env.reset(seed=5)
    infos = [info] + [env.step(action)[-1] for action in actions[0]]
    np.testing.assert_allclose([i["state"] for i in infos], expected.states[0], rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose([i["measurement"] for i in infos], expected.measurements[0], rtol=1e-12, atol=1e-14)
    assert infos[-1]["time"] == pytest.approx(0.9)


@as_python
@every_mode
def test_a_copy_is_the_single_env_with_its_seed(mode):
    ends = assert_copies_are_single_envs("Cart-v0", 3, mode, 40, 7, [0, 1, 2], inputs=2, **LOSING)
    assert ends.all()  # some were terminated, some truncated


@as_python
def test_missing_measurements_are_flagged_and_repeated():
    env = CartEnv(**LOSING)
    last, lost = env.reset(seed=3)[1]["measurement"][0], 0
    for _ in range(30):
        observation, *_, info = env.step(ACTION)
        assert info["measurement_valid"].dtype == bool and info["measurement_valid"][1]
        assert observation[2] == info["measurement_valid"][0] and observation[3] == np.float32(info["state"][2])
        assert info["measurement_valid"][0] != (info["measurement"][0] == last)
        last, lost = info["measurement"][0], lost + (not info["measurement_valid"][0])
    assert 3 < lost < 20


@as_python
@pytest.mark.parametrize("action", ["no", [1.0], 2.0, [1.0, np.nan], [[1.0, 2.0]], None])
def test_a_wrong_action_leaves_the_env_where_it_was(action):
    env, envs = CartEnv(), CartVectorEnv(2)
    env.reset(seed=1), envs.reset(seed=1)
    rule = r"an action must be 2 numbers and not NaN \(command \[V\], slope \[m/s\^2\]\), but got"
    with pytest.raises(ValueError, match=rule):
        env.step(action)
    with pytest.raises(ValueError, match=r"actions must be .*rows of 2 numbers \(command \[V\], slope"):
        envs.step([action] * 2)
    assert env.step(ACTION)[-1]["time"] == pytest.approx(0.1)
    np.testing.assert_allclose(envs.step([ACTION] * 2)[-1]["time"], 0.1)
