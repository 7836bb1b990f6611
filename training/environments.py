"""The envs of a setup, as Stable-Baselines3 takes them: native in number, or single ones side by side."""

from __future__ import annotations

from collections.abc import Sequence

import gymnasium as gym
import numpy as np
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecMonitor

from filters import EstimateState, EstimateStates
from filters.registry import tunable_numbers
from plants.observe import ObserveState, ObserveStateVector
from training.controllers import CorrectController
from training.observations import find_arm
from training.plants.find import plant_of
from training.setup import Setup
from training.vec_env import NativeVecEnv
from training.views import ShowHistory, ShowOutput


def make_environments(
    setup: Setup,
    seeds: Sequence[int],
    *,
    native: bool = True,
    endless: bool = False,
    render_mode: str | None = None,
) -> VecEnv:
    """Envs of a setup, one for each seed, which observe what its arm does; actions are in [-1, 1].

    Args:
        setup: what is observed, of what.
        seeds: of the first episodes.
        native: step all copies in one call; else single envs one after another, with the same numbers.
        endless: no time limit; only native ones.
        render_mode: "human" or "rgb_array"; only single ones.

    Raises:
        ValueError: if an argument of env or filter is off.
    """
    if native:
        venv: VecEnv = NativeVecEnv(_vector_env(setup, len(seeds), endless))
    else:
        venv = DummyVecEnv([lambda: make_single(setup, render_mode) for _ in seeds])
    arm, one = find_arm(setup.observe), make_single(setup).env
    if arm.pairs:
        venv = ShowHistory(venv, arm.pairs, one.unwrapped.appended_entries)
    plant = plant_of(setup.task)
    if arm.shows_state and plant.output is not None:
        model = one.unwrapped.state_space_model() if arm.is_true else one.filter.model
        venv = ShowOutput(venv, model, plant.output)
    if setup.controller is not None:
        venv = CorrectController(venv, plant.corrected(setup.controller, one), setup.share)
    seed_episodes(venv, seeds)
    return VecMonitor(venv)


def seed_episodes(venv: VecEnv, seeds: Sequence[int]) -> None:
    """Give each env the seed of the episode that its next reset begins; `VecEnv.seed` gives consecutive ones."""
    venv.unwrapped._seeds = list(seeds)


def make_single(setup: Setup, render_mode: str | None = None) -> gym.Env:
    """One env of a setup, with its filter; outputs and history are for `make_environments` to show."""
    arm = find_arm(setup.observe)
    env = gym.make(setup.env_id, render_mode=render_mode, disable_env_checker=True, **setup.env_arguments)
    if arm.is_true:
        env = ObserveState(env)
    elif arm.filter is not None:
        env = EstimateState(env, arm.filter, arm.form, **_filter_arguments(setup))
    return gym.wrappers.RescaleAction(env, np.float32(-1.0), np.float32(1.0))


def _filter_arguments(setup: Setup) -> dict:
    """Arguments of the wrapper; where the filter assumes another plant than the env's, a model of that one."""
    arguments = dict(setup.filter_arguments)
    own = {
        name: arguments.pop(name) for name in tunable_numbers(find_arm(setup.observe).filter) if name in arguments
    }
    if setup.assumed_plant is None:
        return {"model_arguments": arguments, **own}
    return {"model": plant_of(setup.task).model(**{**setup.assumed_plant, **arguments}), **own}


def _vector_env(setup: Setup, count: int, endless: bool) -> gym.vector.VectorEnv:
    arm, limit = find_arm(setup.observe), gym.spec(setup.env_id).max_episode_steps
    make = gym.envs.registration.load_env_creator(gym.spec(setup.env_id).vector_entry_point)
    steps = None if endless else limit
    env = make(num_envs=count, max_episode_steps=steps, autoreset_mode="SameStep", **setup.env_arguments)
    if arm.is_true:
        return ObserveStateVector(env)
    if arm.filter is not None:
        return EstimateStates(env, arm.filter, arm.form, **_filter_arguments(setup))
    return env
