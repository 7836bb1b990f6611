"""Registered envs with a filter around them: `gym.make("filters:BowThruster-EnKF-v0")`, single and in number.

Each id is that of an env with the filter's name in it. The keyword arguments are those of the env; `observation`
and `filter_arguments` (a mapping) are those of the wrapper.
"""

from __future__ import annotations

from collections.abc import Mapping

import gymnasium as gym
from gymnasium.envs.registration import load_env_creator, register, registry

from filters.registry import FILTERS
from filters.wrappers.single import EstimateState
from filters.wrappers.vector import EstimateStates
from numerics.checks import shown
from thruster_env.model import ENV_IDS

_SPELLING = {"enkf": "EnKF", "ensrf": "EnSRF", "denkf": "DEnKF", "ienkf": "IEnKF", "low-pass": "LowPass"}


def filtered_id(env_id: str, filter_name: str) -> str:
    """The id of an env with a filter: "BowThruster-v0" and "enkf" give "BowThruster-EnKF-v0"."""
    name, version = env_id.rsplit("-", 1)
    words = filter_name.split("-")
    plain = filter_name.upper() if len(words) == 1 else "".join(word.capitalize() for word in words)
    return f"{name}-{_SPELLING.get(filter_name, plain)}-{version}"


def make_env(
    env_id: str,
    filter: str,
    observation: str = "estimate",
    filter_arguments: Mapping | None = None,
    **env_arguments,
) -> EstimateState:
    """A single env of an id with a filter around it; see `EstimateState` for the arguments."""
    env = load_env_creator(gym.spec(env_id).entry_point)(**env_arguments)
    return EstimateState(env, filter, observation, **_checked(filter_arguments))


def make_vector_env(
    env_id: str,
    filter: str,
    observation: str = "estimate",
    filter_arguments: Mapping | None = None,
    **env_arguments,
) -> EstimateStates:
    """The native vector env of an id with a filter on every copy; see `EstimateStates` for the arguments."""
    env = load_env_creator(gym.spec(env_id).vector_entry_point)(**env_arguments)
    return EstimateStates(env, filter, observation, **_checked(filter_arguments))


def register_filtered_envs() -> None:
    """Register every bow thruster env with every filter, unless that has been done."""
    for env_id in ENV_IDS:
        for name in FILTERS:
            new_id = filtered_id(env_id, name)
            if new_id not in registry:
                register(
                    id=new_id,
                    entry_point="filters.wrappers.ids:make_env",
                    vector_entry_point="filters.wrappers.ids:make_vector_env",
                    max_episode_steps=gym.spec(env_id).max_episode_steps,
                    kwargs={"env_id": env_id, "filter": name},
                )


def _checked(arguments: Mapping | None) -> dict:
    if arguments is not None and not isinstance(arguments, Mapping):
        raise ValueError(f"filter_arguments must be a mapping, but got {shown(arguments)}")
    return dict(arguments or {})
