"""`NativeVecEnv`: a Gymnasium vector env as the VecEnv that Stable-Baselines3 asks for."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.vec_env import VecEnv

from thruster_env.core.checks import short_repr
from tuning.policies.spaces import box_of

RULE = "env must be a vector env, of gym.make_vec(..., autoreset_mode='SameStep')"


class NativeVecEnv(VecEnv):
    """Step a Gymnasium vector env, all copies in one call, under the contract of Stable-Baselines3.

    A copy whose episode ends is reset within the step; its info then holds `terminal_observation` and
    `TimeLimit.truncated`. All other infos are empty, because a dictionary for each copy and step takes more time
    than the plant; the arrays are in `arrays` instead, with one row for each copy.

    Actions are scaled to [-1, 1], as Stable-Baselines3 recommends.

    Args:
        env: a vector env that resets within the step (autoreset mode "SameStep"), with Box spaces.

    Raises:
        ValueError: if the env is no vector env, or resets in another mode.
    """

    def __init__(self, env: gym.vector.VectorEnv):
        """Adapt the env; see the class."""
        mode = env.metadata.get("autoreset_mode") if isinstance(env, gym.vector.VectorEnv) else None
        if mode is None or AutoresetMode(mode) != AutoresetMode.SAME_STEP:
            got = short_repr(env) if mode is None else f"one with autoreset mode {AutoresetMode(mode).value!r}"
            raise ValueError(f"{RULE}, but got {got}")
        self.env = env
        self.arrays: dict[str, Any] = {}
        space = box_of(env.single_action_space)
        self._low, self._half = space.low, (space.high - space.low) / 2
        actions = gym.spaces.Box(-1.0, 1.0, space.shape, np.float32)
        super().__init__(env.num_envs, env.single_observation_space, actions)

    def reset(self) -> np.ndarray:
        """Start an episode of every copy; those with a seed use it."""
        seeds: Any = self._seeds if self._seeds[0] is not None else None  # vector envs take a list, too
        observations, self.arrays = self.env.reset(seed=seeds, options=self._options[0] or None)
        self.reset_infos = [{} for _ in range(self.num_envs)]
        self._reset_seeds()
        self._reset_options()
        return observations

    def step_async(self, actions: np.ndarray) -> None:
        """Take the actions (num_envs, d) of the next step."""
        self._actions = self._low + (actions + 1.0) * self._half

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict]]:
        """Step all copies."""
        observations, rewards, terminated, truncated, self.arrays = self.env.step(self._actions)
        dones = terminated | truncated
        infos: list[dict] = [{} for _ in range(self.num_envs)]
        for i in np.flatnonzero(dones):
            infos[i]["terminal_observation"] = self.arrays["final_obs"][i]
            infos[i]["TimeLimit.truncated"] = bool(truncated[i] and not terminated[i])
        return observations, rewards.astype(np.float32), dones, infos

    def close(self) -> None:
        """Close the env."""
        self.env.close()

    def get_attr(self, attr_name: str, indices=None) -> list:
        """An attribute of the vector env, once for each copy: the copies are not separate objects."""
        return [self._find(attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices=None) -> None:
        """Set an attribute of the vector env, which all copies share."""
        self._refuse_some(indices)
        setattr(self.env.unwrapped, attr_name, value)

    def env_method(self, method_name: str, *method_args, indices=None, **method_kwargs) -> list:
        """Call a method of the vector env, for all copies at once; the result, once for each copy."""
        self._refuse_some(indices)
        return [self._find(method_name)(*method_args, **method_kwargs)] * self.num_envs

    def env_is_wrapped(self, wrapper_class, indices=None) -> list[bool]:
        """Whether each copy has this wrapper of single envs: none has."""
        return [False for _ in self._get_indices(indices)]

    def _find(self, name: str):
        if name == "render_mode":  # only single envs draw
            return None
        return getattr(self.env, name) if hasattr(self.env, name) else getattr(self.env.unwrapped, name)

    def _refuse_some(self, indices) -> None:
        if indices is not None and len(list(self._get_indices(indices))) < self.num_envs:
            raise ValueError(f"indices must be None, for the copies are one object, but got {indices!r}")
