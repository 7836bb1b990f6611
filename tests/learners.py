"""Small trainings for tests, with episodes of few steps, and fixtures for the files that use them."""

import shutil

import gymnasium as gym
import pytest

from tuning.plants.thruster import find_scenario
from tuning.policies.environments import make_environments
from tuning.policies.learn import train
from tuning.policies.saved import load, read_configuration
from tuning.policies.setup import make_configuration

COPIES, LIMIT = 4, 30
SMALL = {
    "ppo": {"n_steps": 32, "batch_size": 64, "n_epochs": 1, "policy_kwargs": {"net_arch": [8]}},
    "sac": {"learning_starts": 40, "buffer_size": 400, "batch_size": 16, "policy_kwargs": {"net_arch": [8]}},
    "td3": {"learning_starts": 40, "buffer_size": 400, "batch_size": 16, "policy_kwargs": {"net_arch": [8]}},
    "recurrent-ppo": {
        "n_steps": 32,
        "batch_size": 64,
        "n_epochs": 1,
        "policy_kwargs": {"net_arch": [8], "lstm_hidden_size": 4},
    },
}


@pytest.fixture(autouse=True)
def short_episodes(monkeypatch):
    monkeypatch.setattr(gym.spec("BowThrusterTracking-v0"), "max_episode_steps", LIMIT)


def setup_of(observe="ekf", algo="ppo", steps=256, **arguments):
    scenario = find_scenario("medium_noise")
    given = {"num_envs": COPIES, "hyperparameters": SMALL[algo], **arguments}
    return make_configuration("tracking", scenario, observe, algo, steps, **given)


def learn(setup, folder, **arguments):
    return train(setup, folder, **{"evaluations": 2, "checkpoints": 4, "tensorboard": False, **arguments})


def contents(folder):
    return {path.relative_to(folder): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def steps_of(folder):
    return load(folder, make_environments(read_configuration(folder), [0])).model.num_timesteps


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A folder of a finished training."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gym.spec("BowThrusterTracking-v0"), "max_episode_steps", LIMIT)
        return learn(setup_of(), tmp_path_factory.mktemp("trained") / "ekf", tensorboard=True).folder


@pytest.fixture
def copied(trained, tmp_path):
    return shutil.copytree(trained, tmp_path / "ekf")
