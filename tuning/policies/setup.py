"""`TrainingConfiguration`: everything that a policy is trained with, as plain data.

It is read from a policy's folder, which may come from another person. So every entry is checked here before it
reaches Gymnasium, a filter or Stable-Baselines3, and before any other file is opened.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING

from filters.registry import filter_type
from filters.tuned_file import AUGMENTED, read_tuned_file
from thruster_env.core.checks import at_least, one_of, positive, short_repr
from tuning.policies.algorithms import HYPERPARAMETERS, POLICY_ARGUMENTS, find_algorithm
from tuning.policies.observations import find_observation_set
from tuning.policies.plants import plant_of
from tuning.problems.scenario import PlantScenario, plain

# Checks of a training configuration: known names, and known arguments of env, filter and algorithm, all data.


if TYPE_CHECKING:
    pass

VERSION = 1
MOST_ENVS = 100_000  # 100 steps of each take a gigabyte
MOST_STEPS = 10**12
SHARE = 0.2  # largest correction of a controller, as a fraction of the range of its action


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
    accepted = () if observed.filter is None else (*filter_type(observed.filter).numbers, *plant.model_arguments)
    _check_known("env_arguments", setup.env_arguments, plant.env_arguments)
    _check_known(f"filter_arguments of observe={setup.observe!r}", setup.filter_arguments, accepted)
    if setup.assumed_plant is not None:
        _check_known("assumed_plant", setup.assumed_plant, plant.env_arguments)
    known = (*HYPERPARAMETERS, *algorithm.hyperparameters)
    _check_known("hyperparameters", setup.hyperparameters, known)
    _check_known("policy_kwargs", setup.hyperparameters.get("policy_kwargs", {}), POLICY_ARGUMENTS)


def _check_known(name: str, arguments, known: Iterable[str]) -> None:
    if not isinstance(arguments, Mapping):
        raise ValueError(f"{name} must be a mapping, but got {short_repr(arguments)}")
    unknown = [key for key in arguments if key not in known]
    if unknown:
        raise ValueError(
            f"{name} must be among {', '.join(known) or 'none'}, but got {', '.join(map(repr, unknown))}"
        )
    for key, value in arguments.items():
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


@dataclass(frozen=True, kw_only=True)
class TrainingConfiguration:
    """Observations, algorithm, task, plant and numbers of a training.

    Attributes:
        observe: name of an observation set, see `tuning.policies.plants`.
        algo: name of an algorithm, see `tuning.policies.algorithms`.
        task: name of the task.
        scenario: name of the scenario, with the plant and its noise.
        env_id: id of the env.
        env_arguments: arguments of the env.
        filter_arguments: arguments of the filter: its parameters, and those of its model.
        steps: number of training steps of the env.
        seed: seed of the training, and of the held-out data that belong to it.
        num_envs: number of copies of the env.
        hyperparameters: hyperparameters of the algorithm.
        controller: name of the predictive controller that the policy corrects, if any.
        share: the largest correction, as a fraction of each action's range.
        assumed_plant: arguments of the plant that the filter assumes; None for the env's plant. It is in no file.

    Raises:
        ValueError: for an unknown name, or an argument that env, filter or algorithm do not have: a file has data
            only, and cannot name code.
    """

    observe: str
    algo: str
    task: str
    scenario: str
    env_id: str
    env_arguments: Mapping = field(default_factory=dict)
    filter_arguments: Mapping = field(default_factory=dict)
    steps: int
    seed: int = 0
    num_envs: int
    hyperparameters: Mapping = field(default_factory=dict)
    controller: str | None = None
    share: float = SHARE
    assumed_plant: Mapping | None = None

    def __post_init__(self):
        """Check names, and that all arguments are known."""
        check_configuration(self)

    def as_json(self) -> str:
        """The training configuration as text."""
        content = asdict(self)
        del content["assumed_plant"]
        return json.dumps({"version": VERSION, **content}, indent=2) + "\n"

    def differences(self, other: TrainingConfiguration) -> list[str]:
        """Names of what differs, apart from the steps: a longer training continues a shorter one."""
        names = [entry.name for entry in fields(self) if entry.name != "steps"]
        return [name for name in names if getattr(self, name) != getattr(other, name)]


def make_configuration(
    task: str,
    scenario: PlantScenario,
    observe: str,
    algo: str = "ppo",
    steps: int | None = None,
    seed: int = 0,
    *,
    filter_arguments: Mapping | None = None,
    tuned: str | Path | None = None,
    num_envs: int | None = None,
    hyperparameters: Mapping | None = None,
    controller: str | None = None,
    share: float = SHARE,
) -> TrainingConfiguration:
    """A training configuration from names; arguments that are None have the algorithm's default.

    The plant is the scenario's, and so is the filter's model: with the scenario's assumed parameters and the
    plant's Q and R, unless `filter_arguments` or a tuned file change them.

    Raises:
        ValueError: for unknown names, a scenario of a linear plant, a tuned file of another filter than the
            observation set's, or numbers out of range.
    """
    kind = plant_of(task)
    chosen = kind.tasks[task]
    observed, algorithm = find_observation_set(observe), find_algorithm(algo)
    kind.check_scenario(scenario)
    if observed.filter is None and (filter_arguments or tuned):
        raise ValueError(
            f"filter arguments must come with an observation set that has a filter, but got {observe!r}"
        )
    assumed = {name: value for name, value in plain(scenario.held).items() if value}
    arguments = {**observed.numbers, **assumed} if observed.filter is not None else {}
    if tuned is not None:
        content = read_tuned_file(tuned)
        tuned_filter = content["filter"]
        if AUGMENTED in tuned_filter["model"]:
            raise ValueError(
                f"a policy's filter must have the plant's states, but {tuned} has constants as states"
            )
        one_of(
            "filter of the tuned file", tuned_filter["name"], () if observed.filter is None else (observed.filter,)
        )
        scenario.check_tuned_for(content.get("plant"), tuned)
        arguments |= {**tuned_filter["numbers"], **tuned_filter["model"]}
    arguments |= filter_arguments or {}
    return TrainingConfiguration(
        observe=observe,
        algo=algo,
        task=task,
        scenario=scenario.name,
        env_id=chosen.env_id,
        env_arguments={**scenario.plant_arguments, **chosen.arguments},
        filter_arguments=arguments,
        steps=at_least("steps", algorithm.steps if steps is None else steps, 1, MOST_STEPS),
        seed=at_least("seed", seed, 0),
        num_envs=at_least("num_envs", algorithm.num_envs if num_envs is None else num_envs, 1, MOST_ENVS),
        hyperparameters={
            **algorithm.hyperparameters,
            **kind.hyperparameters.get(algo, {}),
            **(hyperparameters or {}),
        },
        controller=controller,
        share=share,
    )


def in_scenario(setup: TrainingConfiguration, scenario: PlantScenario) -> TrainingConfiguration:
    """The same observations on another scenario's plant, which is unknown to the filter.

    The filter still assumes the plant of the training configuration.

    Raises:
        ValueError: for a scenario of another plant than the training configuration's, or a linear one.
    """
    kind = plant_of(setup.task)
    kind.check_scenario(scenario)
    of_plant = kind.plant_arguments
    plant = {name: value for name, value in setup.env_arguments.items() if name in of_plant}
    task = {name: value for name, value in setup.env_arguments.items() if name not in of_plant}
    return replace(
        setup,
        scenario=scenario.name,
        env_arguments={**scenario.plant_arguments, **task},
        assumed_plant=plant if setup.assumed_plant is None else setup.assumed_plant,
    )


def configuration_from_json(text: str, name: str) -> TrainingConfiguration:
    """The inverse of `TrainingConfiguration.as_json`; `name` is that of the file, for errors.

    Raises:
        ValueError: if it is not the text of a training configuration, or one of a later version.
    """
    try:
        entries = json.loads(text)
        version = entries.pop("version")
        if version > VERSION:
            raise ValueError(f"{name} must be of version {VERSION} or before, but is of version {version}")
        if "assumed_plant" in entries:
            raise KeyError("assumed_plant")
    except (json.JSONDecodeError, RecursionError, TypeError, KeyError, AttributeError):
        raise ValueError(f"{name} must hold the configuration of a policy, but got {short_repr(text)}") from None
    try:
        return TrainingConfiguration(**entries)
    except TypeError:  # an entry too many or too few
        raise ValueError(f"{name} must hold the configuration of a policy, but got {short_repr(text)}") from None
    except ValueError as error:
        raise ValueError(f"{error} (in {name})") from None
