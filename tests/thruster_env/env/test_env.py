"""The mechanics of an env, on a plant that is no thruster: three states, two inputs, two channels."""

import copy
import inspect
import json
import pickle

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from filters import EstimateState
from tests.small_plant import INPUTS, Cart, CartEnv, CartVectorEnv
from tests.thruster_env.thruster.test_vector_env import (
    DISABLED,
    NEXT_STEP,
    SAME_STEP,
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
def test_modes_differ_in_what_a_step_beyond_the_end_shows():
    shown = {}
    for mode in (NEXT_STEP, SAME_STEP, DISABLED):
        env = CartVectorEnv(2, 2, mode)
        env.reset(seed=1)
        env.step(np.zeros((2, 2)))
        shown[mode] = env.step(np.zeros((2, 2)))[-1]["time"][0]
        if mode == NEXT_STEP:
            assert env.step(np.full((2, 2), np.nan))[-1]["time"][0] == 0.0  # the actions of a reset are ignored
    assert shown == {NEXT_STEP: pytest.approx(0.2), SAME_STEP: 0.0, DISABLED: pytest.approx(0.2)}


@as_python
@pytest.mark.parametrize("other", [copy.copy, copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_copies_and_pickles_go_on_with_the_same_numbers(other):
    for env, action in ((CartEnv(**LOSING), ACTION), (CartVectorEnv(2, **LOSING), [ACTION] * 2)):
        env.reset(seed=1)
        env.step(action)
        again = other(env)
        for _ in range(3):
            one, two = env.step(action), again.step(action)
            np.testing.assert_equal(two, one)


@as_python
def test_the_spec_is_json():
    env = gym.make(
        "Cart-v0", mass=3.0, sensors={"position": CartEnv(**LOSING).plant.sensors["speed"], "speed": ()}
    )
    content = json.loads(env.spec.to_json())
    assert content["kwargs"]["sensors"]["position"][0]["name"] == "dropout"
    assert (
        gym.make(gym.envs.registration.EnvSpec.from_json(env.spec.to_json())).unwrapped.plant
        == env.unwrapped.plant
    )


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


@as_python
def test_arguments_stand_in_one_place():
    assert list(inspect.signature(CartEnv).parameters) == ["mass", "dt", "sensors", "render_mode"]
    assert CartEnv(3.0).plant.mass == 3.0
    with pytest.raises(TypeError, match=r"^CartEnv.__init__\(\) got an unexpected keyword argument 'weight'$"):
        CartEnv(weight=1.0)
    with pytest.raises(ValueError, match="mass must be positive, but got 0"):
        CartVectorEnv(2, mass=0)
    with pytest.raises(ValueError, match="render_mode must be None, but got 'human'"):
        CartEnv(render_mode="human")
    with pytest.raises(ValueError, match="of a cart's model must be among process_noise_cov, but got 'mass'"):
        CartEnv().state_space_model(mass=1.0)


@as_python
def test_a_filter_finds_the_env_s_model():
    env = EstimateState(CartEnv(), "kf")
    env.reset(seed=2)
    for _ in range(20):
        *_, info = env.step(ACTION)
    assert isinstance(env.unwrapped.plant, Cart) and info["estimate"].shape == (3,)
    errors = np.abs(info["estimate"] - info["state"]) / np.sqrt(np.diag(info["estimate_cov"]))
    assert (errors < 4).all()
