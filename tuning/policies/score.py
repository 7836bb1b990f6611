"""Scores of policies on held-out episodes: return, and tracking errors.

Learnt and classical policies run in the same loop, on the same seeds, in native envs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from tuning.policies.environments import episode_steps, make_environments, native_of
from tuning.policies.plants.find import plant_of
from tuning.policies.plants.plant import Part, TrainingPlant
from tuning.policies.setup import TrainingConfiguration


class Policy(Protocol):
    """A policy that acts on observations (n, d), as Stable-Baselines3's models do."""

    def predict(self, observation, state=None, episode_start=None, deterministic: bool = True):
        """Actions (n, p) in [-1, 1], and the policy's state."""


class Scores(NamedTuple):
    """Return and errors of a policy in B episodes."""

    returns: np.ndarray  # (B,)
    parts: Mapping[str, Part]  # errors by name, see `TrainingPlant.parts_of`


def score(policy: Policy, setup: TrainingConfiguration, seeds: Sequence[int]) -> Scores:
    """Run a policy, deterministic, for one episode of each seed in the envs of a setup.

    Args:
        policy: learnt or classical.
        setup: the training configuration of the envs, with the observations that the policy needs.
        seeds: held-out seeds.
    """
    steps = episode_steps(setup.env_id)
    venv, kind = make_environments(setup, seeds, endless=True), plant_of(setup.task)
    returns, recorded, alive = run_episodes(policy, venv, steps, kind)
    base: Any = native_of(venv).env.unwrapped
    return Scores(returns, kind.parts_of(recorded, alive, base.plant))


def run_episodes(
    policy: Policy, venv: VecEnv, steps: int, kind: TrainingPlant
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns (B,), what the plant records (q, B, K), and the steps in which each first episode continues (B, K).

    A step that ends an episode is part of its return; its record is already the start of the next episode.
    """
    observations, state, native = venv.reset(), None, native_of(venv)
    starts, going = np.ones(venv.num_envs, dtype=bool), np.ones(venv.num_envs, dtype=bool)
    returns, rows, alive = np.zeros(venv.num_envs), [], []
    for _ in range(steps):
        actions, state = policy.predict(observations, state, starts, deterministic=True)
        observations, rewards, starts, _ = venv.step(actions)
        returns += np.where(going, rewards, 0.0)
        going &= ~starts
        rows.append(kind.recorded(native.arrays, np.asarray(observations)))
        alive.append(going.copy())
    return returns, np.array(rows).transpose(1, 2, 0), np.array(alive).T
