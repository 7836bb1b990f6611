"""`Episodes`: the env of an `EnvProblem`, which offers the problem's model and shows what its data hold."""

from __future__ import annotations

from typing import TYPE_CHECKING

import gymnasium as gym
import numpy as np
from gymnasium.utils.seeding import np_random

from thruster_env.core.checks import covariance_root
from thruster_env.core.global_generators import GlobalGenerators
from thruster_env.core.streams import ADDED_NOISE, GLOBAL_GENERATORS, derived_seed, draw_key, normal_block
from tuning.problems.model_problem import NamedArguments

if TYPE_CHECKING:
    from tuning.problems.env_problem import EnvProblem


class Episodes(gym.Wrapper):
    """An env that offers filters a problem's model; the first episode of a seed has the measurements of its data.

    `info` holds "measurement" (m,), with the noise that the problem adds, and where the problem knows it "state"
    (n,). Observation, reward and all else are the env's. After a seeded reset the env has its own global
    generators.

    Args:
        env: of the problem.
        problem: its model, and how it measures.
    """

    def __init__(self, env: gym.Env, problem: EnvProblem):
        """Take env and problem."""
        super().__init__(env)
        self.state_space_model = NamedArguments(problem)
        self._problem, self._generator, self._key, self._step = problem, np_random()[0], np.zeros(2), 0
        self._generators = GlobalGenerators()

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        """Reset the env, and draw the key of the episode's measurement noise."""
        if seed is not None:
            self._generators.seed(derived_seed(seed, GLOBAL_GENERATORS))
            self._generator = np_random(seed)[0]
        with self._generators.used():
            observation, info = self.env.reset(seed=seed, options=options)
            self._key, self._step = draw_key(self._generator), 0
            return observation, self._told(observation, info)

    def step(self, action):
        """Step the env."""
        with self._generators.used():
            observation, reward, terminated, truncated, info = self.env.step(action)
            self._step += 1
            return observation, reward, terminated, truncated, self._told(observation, info)

    def _told(self, observation, info: dict) -> dict:
        problem, info = self._problem, dict(info)
        z = problem.measured(observation, info)
        if problem.noise_cov is not None:
            z = z + measurement_noise(self._key[None], np.array([self._step]), problem.noise_cov)[0, 0]
        if problem.measure is not None:  # whose entries are no longer those that the env's flags are of
            info.pop("measurement_valid", None)
        info["measurement"] = z
        if problem.has_truth and (problem.state_of is not None or "state" in info):
            info["state"] = problem.state(self.env, info)
        return info


def measurement_noise(keys: np.ndarray, steps: np.ndarray, cov: np.ndarray) -> np.ndarray:
    """Normal noise (B, K, m) with a covariance, a function of each episode's key and the step only.

    Args:
        keys: of the episodes, (B, 2).
        steps: numbers of the steps, (K,).
        cov: covariance (m, m).
    """
    size = len(cov)
    blocks = [normal_block(b, steps[None], ADDED_NOISE, keys[:, :1], keys[:, 1:]) for b in range(-(-size // 4))]
    draws = np.stack([one for block in blocks for one in block][:size], axis=-1)
    return draws @ covariance_root(cov).T
