"""Checks of a training configuration: known names, and known arguments of env, filter and algorithm, all data.

It is read from a policy's folder, which may come from another person. So every entry is checked here before it
reaches Gymnasium, a filter or Stable-Baselines3, and before any other file is opened.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

from filters.registry import filter_type
from thruster_env.core.checks import at_least, one_of, positive, short_repr
from tuning.policies.algorithms import HYPERPARAMETERS, POLICY_ARGUMENTS, find_algorithm
from tuning.policies.observations import find_observation_set
from tuning.policies.plants.find import plant_of

if TYPE_CHECKING:
    from tuning.policies.setup import TrainingConfiguration


def check_configuration(setup: TrainingConfiguration) -> None:
    """Raise ValueError, with rule and value, for an entry of a configuration that is unknown or not data."""
    plant = plant_of(setup.task)
    one_of("env_id", setup.env_id, (plant.tasks[setup.task].env_id,))
    observed, algorithm = find_observation_set(setup.observe), find_algorithm(setup.algo)
    if not isinstance(setup.scenario, str):
        raise ValueError(f"scenario must be a name, but got {short_repr(setup.scenario)}")
    for name, least in (("steps", 1), ("seed", 0), ("num_envs", 1)):
        at_least(name, getattr(setup, name), least)
    if setup.controller is not None:
        one_of("controller", setup.controller, plant.correctable)
        plant.check_observes(setup.controller, setup.observe)
    positive("share", setup.share)
    own = () if observed.filter is None else (*filter_type(observed.filter).numbers, *plant.model_arguments)
    _check_known("env_arguments", setup.env_arguments, plant.env_arguments)
    _check_known(f"filter_arguments of observe={setup.observe!r}", setup.filter_arguments, own)
    if setup.assumed_plant is not None:
        _check_known("assumed_plant", setup.assumed_plant, plant.env_arguments)
    known = (*HYPERPARAMETERS, *algorithm.hyperparameters)
    _check_known("hyperparameters", setup.hyperparameters, known)
    _check_known("policy_kwargs", setup.hyperparameters.get("policy_kwargs", {}), POLICY_ARGUMENTS)


def _check_known(name: str, given, known: Iterable[str]) -> None:
    if not isinstance(given, Mapping):
        raise ValueError(f"{name} must be a mapping, but got {short_repr(given)}")
    unknown = [key for key in given if key not in known]
    if unknown:
        raise ValueError(
            f"{name} must be among {', '.join(known) or 'none'}, but got {', '.join(map(repr, unknown))}"
        )
    for key, value in given.items():
        _check_data(f"{name}, {key}", value)


def _check_data(name: str, value) -> None:
    """Raise ValueError unless a value is made of text, finite numbers, lists and mappings, as JSON has them."""
    parts: list | tuple
    if isinstance(value, Mapping):
        parts = [*value.keys(), *value.values()]
    else:
        parts = value if isinstance(value, list | tuple) else ()
    for part in parts:
        _check_data(name, part)
    plain = value is None or isinstance(value, str | int | float | list | tuple | Mapping)
    if not plain or (isinstance(value, float) and not math.isfinite(value)):
        raise ValueError(
            f"{name} must be data: text, finite numbers, lists and mappings, but got {short_repr(value)}"
        )
