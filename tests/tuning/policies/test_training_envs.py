"""Envs for learning: the contract of Stable-Baselines3, native as single, and no truth where none may be."""

import gymnasium as gym
import numpy as np
import pytest

from tests.filters.checks import refused

pytest.importorskip("stable_baselines3")

from gymnasium.wrappers import TimeLimit
from stable_baselines3.common.env_util import is_wrapped
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv, VecCheckNan, VecNormalize

import thruster_env  # noqa: F401 - registers the envs
from tests.slow import slow_but
from thruster_env.thruster.env import BowThrusterTrackingVectorEnv
from tuning.plants.thruster import find_scenario
from tuning.policies.algorithms import OBSERVATION_SETS, STACKED
from tuning.policies.environments import NativeVecEnv, make_environments, make_single
from tuning.policies.setup import in_scenario, make_configuration

COPIES, LIMIT, STEPS = 3, 12, 30
SEEDS = [7, 107, 5]
every_arm = pytest.mark.parametrize("observe", OBSERVATION_SETS)


@pytest.fixture(autouse=True)
def short_episodes(monkeypatch):
    monkeypatch.setattr(gym.spec("BowThrusterTracking-v0"), "max_episode_steps", LIMIT)


def setup_of(observe, scenario="medium_noise", **arguments):
    return make_configuration("manoeuvre", find_scenario(scenario), observe, **arguments)


def actions_of(steps=STEPS, copies=COPIES):
    return np.random.default_rng(0).uniform(-1.2, 1.2, (steps, copies, 1)).astype(np.float32)


def native(**arguments):
    arguments = {"num_envs": COPIES, "max_episode_steps": LIMIT, "autoreset_mode": "SameStep", **arguments}
    return NativeVecEnv(BowThrusterTrackingVectorEnv(**arguments))


def test_a_step_gives_what_stable_baselines_asks_for():
    venv = native()
    venv.seed(3)
    first = venv.reset()
    assert first.shape == (COPIES, 2) and first.dtype == np.float32
    assert venv.reset_infos == [{}] * COPIES
    for k, actions in enumerate(actions_of(LIMIT), start=1):
        observations, rewards, dones, infos = venv.step(actions)
        assert observations.shape == (COPIES, 2) and observations.dtype == np.float32
        assert rewards.shape == (COPIES,) and rewards.dtype == np.float32
        assert dones.shape == (COPIES,) and dones.dtype == bool and dones.all() == (k == LIMIT)
        assert isinstance(infos, list) and len({id(info) for info in infos}) == COPIES
    for info, observation in zip(infos, observations, strict=True):
        assert info["TimeLimit.truncated"] is True
        assert info["terminal_observation"].shape == (2,)
        assert not np.array_equal(info["terminal_observation"], observation)


def test_an_end_before_the_time_limit_is_no_truncation():
    venv = native(max_voltage=1e4)
    venv.seed(0)
    venv.set_options({"state": [1e9, 0.0]})
    venv.reset()
    _, _, dones, infos = venv.step(np.zeros((COPIES, 1)))
    assert dones.all() and all(info["TimeLimit.truncated"] is False for info in infos)


def test_seeds_hold_for_one_reset_and_count_up():
    venv, other = native(), native()
    assert venv.seed(11) == [11, 12, 13]
    first, second = venv.reset(), venv.reset()
    assert not np.array_equal(first, second)
    other._seeds = [13, 11, 12]
    np.testing.assert_array_equal(other.reset(), first[[2, 0, 1]])


def test_actions_are_parts_of_the_voltage_range():
    venv, env = native(), BowThrusterTrackingVectorEnv(COPIES, LIMIT, "SameStep")
    venv.seed(1), venv.reset(), env.reset(seed=1)
    observations, rewards, *_ = venv.step(np.array([[-1.0], [0.0], [0.5]]))
    expected = env.step(np.array([[-24.0], [0.0], [12.0]]))
    np.testing.assert_array_equal(observations, expected[0])
    np.testing.assert_array_equal(rewards, expected[1].astype(np.float32))


def test_attributes_and_methods_are_those_of_all_copies():
    venv = native()
    assert [plant.dt for plant in venv.get_attr("plant")] == [0.01] * COPIES
    assert len(venv.get_attr("plant", indices=[0, 2])) == 2 and len(venv.get_attr("plant", indices=1)) == 1
    assert venv.has_attr("task") and not venv.has_attr("no_such_thing")
    venv.set_attr("mark", 4)
    assert venv.get_attr("mark") == [4] * COPIES
    assert [model.n for model in venv.env_method("state_space_model", operating_voltage=3.0)] == [2] * COPIES
    assert venv.env_is_wrapped(TimeLimit) == [False] * COPIES and not is_wrapped(venv, TimeLimit)
    assert venv.render_mode is None
    refused("indices must be None, for the copies are one object, but got 0", venv.set_attr, "mark", 5, indices=0)


def test_only_envs_that_reset_within_the_step_are_taken():
    with pytest.raises(ValueError, match="make_vec.*autoreset_mode='SameStep'.*, but got one with .* 'NextStep'"):
        native(autoreset_mode="NextStep")
    refused("env must be a vector env, of gym.make_vec", NativeVecEnv, gym.make("BowThruster-v0"))


class Still:
    """A policy that leaves the thruster alone."""

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return np.zeros((len(observation), 1), dtype=np.float32), state


def test_helpers_of_stable_baselines_take_the_envs():
    venv = VecNormalize(VecCheckNan(make_environments(setup_of("ekf"), SEEDS), raise_exception=True))
    returns, lengths = evaluate_policy(Still(), venv, n_eval_episodes=6, return_episode_rewards=True)
    assert lengths == [LIMIT] * 6 and all(value < 0 for value in returns)


@pytest.mark.parametrize("observe", slow_but(OBSERVATION_SETS, ["raw", "ekf", "enkf"]))
def test_native_envs_are_single_envs_over_several_episodes(observe):
    setup = setup_of(observe)
    ours, theirs = (make_environments(setup, SEEDS, native=which) for which in (True, False))
    assert isinstance(theirs.unwrapped, DummyVecEnv)
    assert ours.observation_space == theirs.observation_space and ours.action_space == theirs.action_space
    close = {"rtol": 2e-4, "atol": 2e-4}
    np.testing.assert_allclose(ours.reset(), theirs.reset(), **close)
    ended = 0
    for actions in actions_of():
        mine, expected = ours.step(actions), theirs.step(actions)
        np.testing.assert_allclose(mine[0], expected[0], **close)
        np.testing.assert_allclose(mine[1], expected[1], rtol=1e-4, atol=1e-6)
        np.testing.assert_array_equal(mine[2], expected[2])
        for i in np.flatnonzero(mine[2]):
            a, b = mine[3][i], expected[3][i]
            np.testing.assert_allclose(a["terminal_observation"], b["terminal_observation"], **close)
            assert a["TimeLimit.truncated"] == b["TimeLimit.truncated"]
            assert a["episode"]["l"] == b["episode"]["l"] == LIMIT
            assert a["episode"]["r"] == pytest.approx(b["episode"]["r"], rel=1e-4)
            ended += 1
    assert ended == COPIES * (STEPS // LIMIT)


@every_arm
def test_the_reward_is_that_of_the_true_thrust_in_all_arms(observe):
    venv, plain = make_environments(setup_of(observe), SEEDS), make_environments(setup_of("raw"), SEEDS)
    venv.reset(), plain.reset()
    scale, last = thruster_env.thruster.plant.thrust_scale(venv.get_attr("plant")[0]), np.zeros(COPIES)
    for actions in actions_of(LIMIT - 1):
        rewards = venv.step(actions)[1]
        np.testing.assert_array_equal(rewards, plain.step(actions)[1])
        arrays, parts = venv.unwrapped.arrays, np.clip(actions[:, 0], -1, 1)
        error = (arrays["thrust"] - arrays["reference"]) / scale
        np.testing.assert_allclose(rewards, -(error**2) - 0.01 * (parts - last) ** 2, rtol=1e-4)
        last = parts


class FalseTruth(gym.Wrapper):
    """Tells nothing true of what a sensor does not measure."""

    hidden = ("state", "thrust", "ambient_velocity")

    def __init__(self, env, remove):
        super().__init__(env)
        self._remove = remove

    def reset(self, **arguments):
        observation, info = self.env.reset(**arguments)
        return observation, self._changed(info)

    def step(self, action):
        *outcome, info = self.env.step(action)
        return *outcome, self._changed(info)

    def _changed(self, info):
        if self._remove:
            return {name: value for name, value in info.items() if name not in self.hidden}
        return info | {name: 1e3 + 0 * np.asarray(info[name]) for name in self.hidden}


def observations_of(monkeypatch, observe, falsify=None):
    with monkeypatch.context() as patch:
        if falsify is not None:
            make = gym.make
            patch.setattr(gym, "make", lambda *given, **named: falsify(make(*given, **named)))
        venv = make_environments(setup_of(observe), [4], native=False)
    out = [venv.reset()]
    for actions in actions_of(copies=1):
        observations, _, dones, infos = venv.step(actions)
        out += [observations, *(info["terminal_observation"][None] for info in np.array(infos)[dones])]
    return np.concatenate(out)


@pytest.mark.parametrize("remove", [True, False], ids=["removed", "falsified"])
@every_arm
def test_nothing_of_the_truth_is_observed_but_by_the_arm_that_says_so(observe, remove, monkeypatch):
    honest = observations_of(monkeypatch, observe)

    def falsify(env):
        return FalseTruth(env, remove)

    if OBSERVATION_SETS[observe].is_true:
        if not remove:
            assert not np.array_equal(observations_of(monkeypatch, observe, falsify), honest)
        return
    np.testing.assert_array_equal(observations_of(monkeypatch, observe, falsify), honest)


@every_arm
def test_the_entries_of_an_observation_are_those_of_the_table(observe):
    venv, arm = make_environments(setup_of(observe), SEEDS), OBSERVATION_SETS[observe]
    seen, measured = venv.reset(), [venv.unwrapped.arrays["measurement"][:, 0]]
    voltages = [np.zeros(COPIES)]
    env = make_single(setup_of(observe)).env
    for actions in actions_of(LIMIT - 1):
        arrays = venv.unwrapped.arrays
        if arm.pairs:
            count = min(arm.pairs, len(measured))
            pairs = seen[:, :-1].reshape(COPIES, arm.pairs, 2)
            for j in range(count):
                np.testing.assert_allclose(pairs[:, j, 0], measured[-1 - j], rtol=1e-6)
                np.testing.assert_allclose(pairs[:, j, 1], voltages[-1 - j], rtol=1e-6)
            assert (pairs[:, count:] == 0).all()
        elif arm.shows_state:
            states = arrays["state"] if arm.is_true else arrays["estimate"]
            model = env.unwrapped.state_space_model() if arm.is_true else env.filter.model
            np.testing.assert_allclose(seen[:, 1:3], states, rtol=1e-6)
            np.testing.assert_allclose(seen[:, 0], model.output("T", states), rtol=1e-4, atol=1e-3)
            if observe == "belief":
                deviations = np.sqrt(np.diagonal(arrays["estimate_cov"], axis1=1, axis2=2))
                np.testing.assert_allclose(seen[:, 3:5], deviations, rtol=1e-6)
        else:
            np.testing.assert_allclose(seen[:, 0], measured[-1], rtol=1e-6)
        assert seen.shape[1] == {"raw": 2, "raw+action": 3, "stack": 2 * STACKED + 1, "belief": 6}.get(observe, 4)
        before, (seen, *_) = seen, venv.step(actions)
        # The reference that was shown is the one that the reward compares with.
        np.testing.assert_allclose(before[:, -1], venv.unwrapped.arrays["reference"], rtol=1e-6)
        measured.append(venv.unwrapped.arrays["measurement"][:, 0])
        voltages.append(np.clip(actions[:, 0], -1, 1))


def test_on_another_scenario_the_plant_changes_and_what_a_filter_assumes_does_not():
    there = in_scenario(setup_of("ekf", "nominal"), find_scenario("medium_noise"))
    assumed = make_single(there).env.filter.model
    expected = make_single(setup_of("ekf", "nominal")).env.filter.model
    np.testing.assert_array_equal(assumed.numbers, expected.numbers)
    plant = make_single(there).unwrapped.plant
    assert plant.measurement_noise_cov[0, 0] == 4.0 and expected.measurement_noise_cov[0, 0] == 0.25
    # The task stays, and a second move starts from what was first assumed.
    assert there.env_arguments["reference"] == setup_of("ekf").env_arguments["reference"]
    again = in_scenario(there, find_scenario("ambient"))
    np.testing.assert_array_equal(make_single(again).env.filter.model.numbers, expected.numbers)
    with pytest.raises(ValueError, match="the thruster's equations, but 'published_tunnel' is linear"):
        in_scenario(there, find_scenario("published_tunnel"))
