"""The true state as observation: the reference for policies that must work with estimates."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector.utils import batch_space


class ObserveState(gym.Wrapper, gym.utils.RecordConstructorArgs):
    """Observe the true state of a plant instead of the measurement.

    Entries that the env appends to its measurement (validity flags, a reference signal) stay at the end.

    Args:
        env: an env of a plant.
    """

    def __init__(self, env: gym.Env):
        """Wrap the env; see the class."""
        gym.utils.RecordConstructorArgs.__init__(self)
        gym.Wrapper.__init__(self, env)
        base: Any = env.unwrapped
        self._appended = base.appended_entries
        self.observation_space = _space(base.report_rows.states + self._appended)

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        """Reset the env."""
        observation, info = self.env.reset(seed=seed, options=options)
        return _observed(info["state"], observation, self._appended), info

    def step(self, action):
        """Step the env."""
        observation, *outcome, info = self.env.step(action)
        return _observed(info["state"], observation, self._appended), *outcome, info


class ObserveStateVector(gym.vector.VectorWrapper):
    """`ObserveState` for vector envs, in all three autoreset modes.

    Args:
        env: a vector env of a plant.
    """

    def __init__(self, env: gym.vector.VectorEnv):
        """Wrap the envs; see the class."""
        super().__init__(env)
        base: Any = env.unwrapped
        self._appended = base.appended_entries
        self.single_observation_space = _space(base.report_rows.states + self._appended)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)

    def reset(self, *, seed: int | list[int | None] | None = None, options: dict | None = None):
        """Reset the envs."""
        seeds: Any = seed  # Gymnasium takes a list of them, too, but its annotation does not say so
        observations, info = self.env.reset(seed=seeds, options=options)
        return _observed(info["state"], observations, self._appended), info

    def step(self, actions):
        """Step the envs."""
        observations, *outcome, info = self.env.step(actions)
        if "final_obs" in info:
            for i in np.flatnonzero(info["_final_obs"]):
                last = info["final_info"]["state"][i]
                info["final_obs"][i] = _observed(last, info["final_obs"][i], self._appended)
        return _observed(info["state"], observations, self._appended), *outcome, info


def _space(entries: int) -> gym.spaces.Box:
    return gym.spaces.Box(-np.inf, np.inf, shape=(entries,), dtype=np.float32)


def _observed(state: np.ndarray, observation: np.ndarray, appended: int) -> np.ndarray:
    """State (..., n), then the last entries of an observation (..., d), in float32."""
    kept = observation[..., observation.shape[-1] - appended :]
    with np.errstate(over="ignore"):  # beyond 3.4e38 lies infinity
        return np.concatenate([state.astype(np.float32), kept], axis=-1)
