"""Registered envs with a filter around them: `gym.make("filters:BowThruster-EnKF-v0")`, also as vector envs.

The entry point group PLANTS lists packages whose envs offer a model. Each of their ids gets a filtered one,
    "BowThruster-Filtered-v0", whose argument `filter` names the filter, and one for each filter of ALIASES.
"""

from __future__ import annotations

import importlib.metadata
from collections.abc import Mapping
from typing import Any

import gymnasium as gym
from gymnasium.envs.registration import load_env_creator, register, registry

from filters.wrappers.single import EstimateState
from filters.wrappers.vector import EstimateStates
from thruster_env.core.checks import short_repr

PLANTS = "filters.plants"  # group of entry points: packages that register their envs when imported
ALIASES = {"kf": "KF", "ekf": "EKF", "ukf": "UKF", "enkf": "EnKF", "pf": "PF"}


def filtered_id(env_id: str, word: str = "Filtered") -> str:
    """The id of an env with a filter: "BowThruster-v0" and "EnKF" give "BowThruster-EnKF-v0"."""
    name, version = env_id.rsplit("-", 1)
    return f"{name}-{word}-{version}"


def make_env(
    env_id: str,
    filter: str = "ekf",
    observation: str = "estimate",
    filter_arguments: Mapping | None = None,
    model_arguments: Mapping | None = None,
    **env_arguments,
) -> EstimateState:
    """A single env of an id with a filter around it; see `EstimateState` for the arguments.

    `filter_arguments` are the filter's own parameters; all arguments that are not named here go to the env.
    """
    env = _made(gym.spec(env_id).entry_point, env_arguments)
    numbers = _checked(filter_arguments)
    return EstimateState(env, filter, observation, model_arguments=model_arguments, **numbers)


def make_vector_env(
    env_id: str,
    filter: str = "ekf",
    observation: str = "estimate",
    filter_arguments: Mapping | None = None,
    model_arguments: Mapping | None = None,
    **env_arguments,
) -> EstimateStates:
    """The native vector env of an id with a filter on every copy; see `EstimateStates` for the arguments."""
    env = _made(gym.spec(env_id).vector_entry_point, env_arguments)
    numbers = _checked(filter_arguments)
    return EstimateStates(env, filter, observation, model_arguments=model_arguments, **numbers)


def _made(entry: Any, arguments: Mapping) -> Any:
    create = load_env_creator(entry) if isinstance(entry, str) else entry
    return create(**arguments)


def modelled_ids() -> list[str]:
    """Ids of registered envs, of the packages in PLANTS, whose class offers a model."""
    packages = {point.value for point in importlib.metadata.entry_points(group=PLANTS)}
    for package in sorted(packages):
        importlib.import_module(package)
    ids = []
    for env_id, spec in registry.items():
        entry = spec.entry_point
        if isinstance(entry, str) and entry.partition(".")[0].partition(":")[0] in packages:
            if hasattr(load_env_creator(entry), "state_space_model"):
                ids.append(env_id)
    return ids


def register_filtered_envs() -> None:
    """Register every env that offers a model with a filter around it; a second call has no effect."""
    for env_id in modelled_ids():
        for word, filter in [("Filtered", None), *((word, name) for name, word in ALIASES.items())]:
            if filtered_id(env_id, word) not in registry:
                spec = gym.spec(env_id)
                register(
                    id=filtered_id(env_id, word),
                    entry_point="filters.wrappers.ids:make_env",
                    vector_entry_point="filters.wrappers.ids:make_vector_env",
                    max_episode_steps=spec.max_episode_steps,
                    kwargs={"env_id": env_id} | ({} if filter is None else {"filter": filter}),
                )


def _checked(arguments: Mapping | None) -> dict:
    if arguments is not None and not isinstance(arguments, Mapping):
        raise ValueError(f"filter_arguments must be a mapping, but got {short_repr(arguments)}")
    return dict(arguments or {})
