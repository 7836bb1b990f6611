import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env

import thruster_env  # noqa: F401 - registers the envs
from thruster_env.env.env import ObserveState, ObserveStateVector

DROPPING = {"thrust": [{"name": "dropout", "probability": 0.5}], "speed": []}


# Its advice on bounds is not ours: volts are volts, and Gaussian noise has no bounds.
# And it is the wrapper that is to be checked.
@pytest.mark.filterwarnings(r"ignore:.*(symmetric and normalized|probably too|is different from the):UserWarning")
@pytest.mark.parametrize("task", ["", "Tracking", "Linear"])
def test_gymnasiums_checker_passes(task):
    check_env(ObserveState(gym.make(f"BowThruster{task}-v0").unwrapped), skip_render_check=True)


@pytest.mark.parametrize("task", ["", "Tracking"])
@pytest.mark.parametrize("sensors", [None, DROPPING])
def test_the_state_stands_in_for_the_measurement_only(task, sensors):
    plain = gym.make(f"BowThruster{task}-v0", sensors=sensors)
    env = ObserveState(gym.make(f"BowThruster{task}-v0", sensors=sensors))
    measured, (observation, info) = plain.reset(seed=3)[0], env.reset(seed=3)
    for _ in range(20):
        kept = measured[len(plain.unwrapped.plant.channels) :]
        np.testing.assert_array_equal(observation, np.append(info["state"].astype(np.float32), kept))
        assert observation in env.observation_space
        action = env.action_space.sample()
        measured, (observation, *_, info) = plain.step(action)[0], env.step(action)


def test_it_is_part_of_the_spec():
    env = ObserveState(gym.make("BowThrusterTracking-v0", preset="t200"))
    again = gym.make(EnvSpec.from_json(env.spec.to_json()))
    assert isinstance(again, ObserveState)
    np.testing.assert_array_equal(again.reset(seed=1)[0], env.reset(seed=1)[0])


@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
def test_envs_in_number_show_what_each_alone_shows(mode):
    env = ObserveStateVector(
        gym.make_vec("BowThrusterTracking-v0", 3, max_episode_steps=5, sensors=DROPPING, autoreset_mode=mode)
    )
    alone = [ObserveState(gym.make("BowThrusterTracking-v0", sensors=DROPPING)) for _ in range(3)]
    observations, _ = env.reset(seed=8)
    assert observations in env.observation_space and env.single_observation_space == alone[0].observation_space
    np.testing.assert_array_equal(observations, [single.reset(seed=8 + i)[0] for i, single in enumerate(alone)])
    for k in range(1, 12):
        actions = env.action_space.sample()
        observations, _, _, truncated, info = env.step(actions)
        if mode == "NextStep" and k % 6 == 0:
            expected = [single.reset()[0] for single in alone]
        else:
            expected = [single.step(action)[0] for single, action in zip(alone, actions, strict=True)]
        if mode == "SameStep" and truncated.all():
            np.testing.assert_array_equal(np.stack(info["final_obs"]), expected)
            expected = [single.reset()[0] for single in alone]
        np.testing.assert_array_equal(observations, expected)
        if mode == "Disabled" and truncated.all():
            observations, _ = env.reset(options={"reset_mask": np.ones(3, dtype=bool)})
            np.testing.assert_array_equal(observations, [single.reset()[0] for single in alone])
