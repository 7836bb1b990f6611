"""The envs of a training configuration, for Stable-Baselines3: native vectorised ones, or single ones."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import load_env_creator
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecMonitor

from filters import EstimateState, EstimateStates
from filters.registry import filter_type
from thruster_env.env.commands import ObserveState, ObserveStateVector
from tuning.policies.controllers import CorrectController
from tuning.policies.observations import find_observation_set
from tuning.policies.plants.find import plant_of
from tuning.policies.setup import TrainingConfiguration
from tuning.policies.vec_env import NativeVecEnv
from tuning.policies.views import ShowHistory, ShowOutput


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
