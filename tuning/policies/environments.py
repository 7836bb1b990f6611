"""The envs of a training configuration for Stable-Baselines3: native vectorised ones, or single ones.

`NativeVecEnv` gives a Gymnasium vector env the interface of Stable-Baselines3's VecEnv. `ShowOutput` and
`ShowHistory` change what a policy observes: an output of the state, or the last measurements and actions. With
`CorrectController` a policy corrects a classical controller.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import load_env_creator
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecEnvWrapper, VecMonitor

from filters import EstimateState, EstimateStates
from filters.registry import filter_type
from thruster_env.core.checks import short_repr
from thruster_env.env.env import ObserveState, ObserveStateVector
from thruster_env.model.state_space import StateSpaceModel
from tuning.policies.algorithms import box_of, find_observation_set, size_of
from tuning.policies.controllers import ClassicalPolicy
from tuning.policies.setup import TrainingConfiguration, plant_of

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


class CorrectController(VecEnvWrapper):
    """Let a policy correct a controller: a = clip(a_c + share a_p) of the two actions, each in [-1, 1].

    The controller's action is appended to the observation. With a policy of zero action the result is the
    controller.
    Source: T. Johannink et al. (2019), "Residual reinforcement learning for robot control", ICRA, 6023-6029.

    Args:
        venv: envs whose observations the controller takes, with actions in [-1, 1].
        controller: the controller that is corrected.
        share: the largest correction, as a fraction of half of each input's range.
    """

    def __init__(self, venv: VecEnv, controller: ClassicalPolicy, share: float):
        """Wrap the envs; see the class."""
        self._controller, self._share = controller, share
        size = size_of(venv.observation_space) + size_of(venv.action_space)
        super().__init__(venv, gym.spaces.Box(-np.inf, np.inf, (size,), np.float32))

    def reset(self) -> np.ndarray:
        """Reset the envs."""
        observations = self.venv.reset()
        self._actions, self._state = self._controller.predict(observations)
        return np.concatenate([observations, self._actions], axis=1)

    def step_async(self, actions: np.ndarray) -> None:
        """Correct the controller's actions."""
        applied = np.clip(self._actions + self._share * np.clip(actions, -1.0, 1.0), -1.0, 1.0)
        self._controller.replace_last_actions(self._state, applied)
        self.venv.step_async(applied.astype(np.float32))

    def step_wait(self):
        """Step the envs."""
        observations, rewards, dones, infos = self.venv.step_wait()
        for i in np.flatnonzero(dones):
            last = infos[i]["terminal_observation"]
            action, _ = self._controller.predict(last, self._state[i])
            infos[i]["terminal_observation"] = np.concatenate([last, action])
        self._actions, self._state = self._controller.predict(observations, self._state, dones)
        return np.concatenate([observations, self._actions], axis=1), rewards, dones, infos


def _space(size: int) -> gym.spaces.Box:
    return gym.spaces.Box(-np.inf, np.inf, (size,), np.float32)


def make_environments(
    setup: TrainingConfiguration,
    seeds: Sequence[int],
    *,
    native: bool = True,
    endless: bool = False,
    render_mode: str | None = None,
) -> VecEnv:
    """Envs of a training configuration, one for each seed, with its observation set; actions are in [-1, 1].

    Args:
        setup: the training configuration.
        seeds: seeds of the first episodes.
        native: step all copies in one call; else single envs one after another, with the same results.
        endless: no time limit; native envs only.
        render_mode: "human" or "rgb_array"; single envs only.

    Raises:
        ValueError: if an argument of env or filter is invalid.
    """
    if native:
        venv: VecEnv = NativeVecEnv(_vector_env(setup, len(seeds), endless))
    else:
        venv = DummyVecEnv([lambda: make_single(setup, render_mode) for _ in seeds])
    observed = find_observation_set(setup.observe)
    single: Any = make_single(setup).env
    if observed.pairs:
        venv = ShowHistory(venv, observed.pairs, single.unwrapped.appended_entries)
    plant = plant_of(setup.task)
    if observed.shows_state and plant.output is not None:
        model = single.unwrapped.state_space_model() if observed.is_true else single.filter.model
        venv = ShowOutput(venv, model, plant.output)
    if setup.controller is not None:
        venv = CorrectController(venv, plant.corrected(setup.controller, single), setup.share)
    seed_episodes(venv, seeds)
    return VecMonitor(venv)


def seed_episodes(venv: VecEnv, seeds: Sequence[int]) -> None:
    """Give each env the seed of the episode that its next reset begins; `VecEnv.seed` gives consecutive ones."""
    venv.unwrapped._seeds = list(seeds)


def native_of(venv: VecEnv) -> NativeVecEnv:
    """The native envs within wrappers; ValueError for single ones."""
    native = venv.unwrapped
    if not isinstance(native, NativeVecEnv):
        raise ValueError(f"envs must be native, but got {type(native).__name__}")
    return native


def episode_steps(env_id: str) -> int:
    """Steps of an episode of an env; ValueError for one without a time limit."""
    steps = gym.spec(env_id).max_episode_steps
    if steps is None:
        raise ValueError(f"an env must have a time limit, but {env_id} has none")
    return steps


def make_single(setup: TrainingConfiguration, render_mode: str | None = None) -> gym.Wrapper:
    """One env of a training configuration, with its filter; `make_environments` adds outputs and history."""
    observed = find_observation_set(setup.observe)
    env = gym.make(setup.env_id, render_mode=render_mode, disable_env_checker=True, **setup.env_arguments)
    if observed.is_true:
        env = ObserveState(env)
    elif observed.filter is not None:
        env = EstimateState(env, observed.filter, observed.form, **_filter_arguments(setup, observed.filter))
    return gym.wrappers.RescaleAction(env, np.float32(-1.0), np.float32(1.0))


def _filter_arguments(setup: TrainingConfiguration, filter_name: str) -> dict:
    """Arguments of the wrapper; where the filter assumes another plant than the env's, a model of that one."""
    arguments = dict(setup.filter_arguments)
    numbers = {name: arguments.pop(name) for name in filter_type(filter_name).numbers if name in arguments}
    if setup.assumed_plant is None:
        return {"model_arguments": arguments, **numbers}
    return {"model": plant_of(setup.task).model(**{**setup.assumed_plant, **arguments}), **numbers}


def _vector_env(setup: TrainingConfiguration, count: int, endless: bool) -> gym.vector.VectorEnv:
    observed, limit = find_observation_set(setup.observe), gym.spec(setup.env_id).max_episode_steps
    entry: Any = gym.spec(setup.env_id).vector_entry_point  # a text, as this project's envs have it
    make: Any = load_env_creator(entry)
    steps = None if endless else limit
    env = make(num_envs=count, max_episode_steps=steps, autoreset_mode="SameStep", **setup.env_arguments)
    if observed.is_true:
        return ObserveStateVector(env)
    if observed.filter is not None:
        return EstimateStates(env, observed.filter, observed.form, **_filter_arguments(setup, observed.filter))
    return env
