"""The vehicle in number: copy by copy the single env."""

import importlib.metadata

import gymnasium as gym
import pytest

import thruster_env.auv  # noqa: F401 - registers the envs
from filters import wrappers as ids
from tests.thruster_env.auv.test_env import DISTURBED
from tests.thruster_env.thruster.test_vector_env import NEXT_STEP, assert_copies_are_single_envs, every_mode

# Some begin beyond 80 degrees of pitch, or come there.
WILD = DISTURBED | {"initial_state": {"mean": [1.0] + [0.0] * 11, "cov": [0.01] * 7 + [0.7] + [0.01] * 4}}
TASKS = ["SegorogeniAUV-v0", "SegorogeniAUVPath-v0", "SegorogeniAUVDepth-v0"]


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize("name", TASKS)
@every_mode
def test_a_copy_is_the_single_env_with_its_seed(name, mode):
    given = WILD | ({"hold_time": 0.1} if "Depth" in name else {})
    ends = assert_copies_are_single_envs(name, 3, mode, 30, 7, [0, 1, 2], inputs=3, **given)
    assert ends.all()


def test_compiled_copies_of_several_blocks_are_single_envs():
    ends = assert_copies_are_single_envs(
        TASKS[1], 130, NEXT_STEP, 25, 12, [0, 127, 129], exact=range(5), inputs=3, ulps=16, **WILD
    )
    assert ends.sum() >= 6


@pytest.mark.usefixtures("as_python")
def test_ids_with_a_filter_are_made_of_the_vehicles_too(monkeypatch):
    point = importlib.metadata.EntryPoint("thruster_env", "thruster_env", ids.PLANTS)
    monkeypatch.setattr(importlib.metadata, "entry_points", lambda group: [point])
    before = set(gym.registry)
    ids.register_filtered_envs()
    try:
        assert gym.spec("Replay-EKF-v0").vector_entry_point is None  # as of Replay-v0
        env = gym.make("SegorogeniAUVPath-EKF-v0", path="I")
        assert env.reset(seed=0)[0].shape == (12 + 4 + 6,) and env.spec.max_episode_steps == 600
    finally:
        for name in set(gym.registry) - before:
            del gym.registry[name]
