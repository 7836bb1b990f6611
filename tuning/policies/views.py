"""Vectorised observations of a policy: an output of a state, or the last measurements and actions."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper

from thruster_env.model.state_space import StateSpaceModel
from tuning.policies.spaces import box_of, size_of


class ShowOutput(VecEnvWrapper):
    """Put an output that a model has at a state in front of an observation that begins with the state.

    Args:
        venv: envs whose observations begin with the model's states.
        model: the model of the plant that the observer assumes.
        symbol: of the output, such as the thruster's T.
    """

    def __init__(self, venv: VecEnv, model: StateSpaceModel, symbol: str):
        """Wrap the envs; see the class."""
        self._model, self._symbol = model, symbol
        super().__init__(venv, _space(size_of(venv.observation_space) + 1))

    def reset(self) -> np.ndarray:
        """Reset the envs."""
        return self._with_output(np.asarray(self.venv.reset()))

    def step_wait(self):
        """Step the envs."""
        observations, rewards, dones, infos = self.venv.step_wait()
        for i in np.flatnonzero(dones):
            infos[i]["terminal_observation"] = self._with_output(infos[i]["terminal_observation"])
        return self._with_output(np.asarray(observations)), rewards, dones, infos

    def _with_output(self, observations: np.ndarray) -> np.ndarray:
        states = observations[..., : self._model.n].astype(np.float64)
        values = self._model.output(self._symbol, states)
        return np.concatenate([values[..., None].astype(np.float32), observations], axis=-1)


class ShowHistory(VecEnvWrapper):
    """Show the last measurements, each with the action before it, latest first; what the env appends stays last.

    At the start of an episode there is one measurement; earlier entries are zero.

    Args:
        venv: envs whose observations are a measurement, then `appended` entries.
        pairs: number of measurements.
        appended: entries after the measurement, such as the reference.
    """

    def __init__(self, venv: VecEnv, pairs: int, appended: int):
        """Wrap the envs; see the class."""
        self._measured = size_of(venv.observation_space) - appended
        width = self._measured + size_of(venv.action_space)
        self._box = box_of(venv.action_space)
        self._past = np.zeros((venv.num_envs, pairs, width), dtype=np.float32)
        super().__init__(venv, _space(pairs * width + appended))

    def reset(self) -> np.ndarray:
        """Reset the envs; earlier measurements and actions are zero."""
        observations = np.asarray(self.venv.reset())
        return self._begin(np.ones(self.num_envs, dtype=bool), observations)

    def step_async(self, actions: np.ndarray) -> None:
        """Keep the actions as the env takes them, clipped."""
        self._actions = np.clip(actions, self._box.low, self._box.high)
        self.venv.step_async(actions)

    def step_wait(self):
        """Step the envs."""
        raw, rewards, dones, infos = self.venv.step_wait()
        observations = np.asarray(raw)
        last = observations.copy()
        for i in np.flatnonzero(dones):
            last[i] = infos[i]["terminal_observation"]
        self._past[:, 1:] = self._past[:, :-1].copy()
        self._past[:, 0] = np.concatenate([last[:, : self._measured], self._actions], axis=1)
        visible = self._visible(last)
        for i in np.flatnonzero(dones):
            infos[i]["terminal_observation"] = visible[i].copy()
        return (self._begin(dones, observations) if dones.any() else visible), rewards, dones, infos

    def _begin(self, which: np.ndarray, observations: np.ndarray) -> np.ndarray:
        self._past[which] = 0.0
        self._past[which, 0, : self._measured] = observations[which, : self._measured]
        return self._visible(observations)

    def _visible(self, observations: np.ndarray) -> np.ndarray:
        appended = observations[:, self._measured :]
        return np.concatenate([self._past.reshape(self.num_envs, -1), appended], axis=1)


def _space(size: int) -> gym.spaces.Box:
    return gym.spaces.Box(-np.inf, np.inf, (size,), np.float32)
