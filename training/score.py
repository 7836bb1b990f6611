"""How well policies do on held-out episodes: return, and errors of what is to be followed.

Learnt and classical policies run in the same loop, on the same seeds, in native envs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple, Protocol

import gymnasium as gym
import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from training.environments import make_environments
from training.plants.find import plant_of
from training.plants.plant import Part, TrainingPlant
from training.setup import Setup


class Policy(Protocol):
    """What acts on observations (n, d), as Stable-Baselines3's models do."""

    def predict(self, observation, state=None, episode_start=None, deterministic: bool = True):
        """Actions (n, p) in [-1, 1], and what the policy remembers."""


class Scores(NamedTuple):
    """How a policy did in B episodes."""

    returns: np.ndarray  # (B,)
    parts: Mapping[str, Part]  # errors by name, see `TrainingPlant.parts_of`


def score(policy: Policy, setup: Setup, seeds: Sequence[int]) -> Scores:
    """Run a policy, deterministic, for one episode of each seed in the envs of a setup.

    Args:
        policy: learnt or classical.
        setup: of the envs; what is observed has to be what the policy needs.
        seeds: held-out ones.
    """
    steps = gym.spec(setup.env_id).max_episode_steps
    venv, kind = make_environments(setup, seeds, endless=True), plant_of(setup.task)
    returns, recorded, alive = run_episodes(policy, venv, steps, kind)
    return Scores(returns, kind.parts_of(recorded, alive, venv.unwrapped.env.unwrapped.plant))


def run_episodes(
    policy: Policy, venv: VecEnv, steps: int, kind: TrainingPlant
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns (B,), what the plant has recorded (q, B, K), and in which steps each first episode went on (B, K).

    A step that ends an episode counts in its return; what is recorded there is already the next one's start.
    """
    observations, state = venv.reset(), None
    starts, going = np.ones(venv.num_envs, dtype=bool), np.ones(venv.num_envs, dtype=bool)
    returns, rows, alive = np.zeros(venv.num_envs), [], []
    for _ in range(steps):
        actions, state = policy.predict(observations, state, starts, deterministic=True)
        observations, rewards, starts, _ = venv.step(actions)
        returns += np.where(going, rewards, 0.0)
        going &= ~starts
        rows.append(kind.recorded(venv.unwrapped.arrays, observations))
        alive.append(going.copy())
    return returns, np.array(rows).transpose(1, 2, 0), np.array(alive).T
