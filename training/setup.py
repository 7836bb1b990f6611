"""`Setup`: all that a policy was trained with, as one value that JSON can hold."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path

from filters.tuned_file import read_tuned_file
from numerics.checks import at_least, one_of, shown
from training.algorithms import find_algorithm
from training.checks import check_setup
from training.observations import find_arm
from training.plants.find import plant_of
from tuning.problems.plain import plain
from tuning.problems.scenario import BaseScenario

VERSION = 1
MOST_ENVS = 100_000  # whose experience, of 100 steps each, takes a gigabyte
MOST_STEPS = 10**12
SHARE = 0.2  # of the maximum voltage, by which a policy may correct a controller


@dataclass(frozen=True, kw_only=True)
class Setup:
    """What is learnt, from what, by what.

    Attributes:
        observe: name of an arm, see `training.observations`.
        algo: name of an algorithm, see `training.algorithms`.
        task: name of the task.
        scenario: name of the scenario, which says what the plant and its noise are.
        env_id: the env.
        env_arguments: its arguments.
        filter_arguments: of the filter beside it: its own numbers, and what it assumes of the plant.
        steps: steps of the env that are learnt from.
        seed: of training, and of the held-out data that belong to it.
        num_envs: copies of the env.
        hyperparameters: of the algorithm.
        controller: name of the predictive controller that the policy corrects, if any.
        share: the largest correction, as a part of each action's range.
        assumed_plant: arguments of the plant that the filter assumes; None for the env's own. No file has one.

    Raises:
        ValueError: if a name is unknown, or an argument is none that env, filter or algorithm have: whatever comes
            from a file is data, and can name no code.
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
        check_setup(self)

    def as_json(self) -> str:
        """The setup as text."""
        content = asdict(self)
        del content["assumed_plant"]
        return json.dumps({"version": VERSION, **content}, indent=2) + "\n"

    def differences(self, other: Setup) -> list[str]:
        """Names of what differs, apart from the steps: a longer run goes on where a shorter one ended."""
        names = [entry.name for entry in fields(self) if entry.name != "steps"]
        return [name for name in names if getattr(self, name) != getattr(other, name)]


def make_setup(
    task: str,
    scenario: BaseScenario,
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
) -> Setup:
    """A setup from names; what is None is the algorithm's default.

    The plant is the scenario's, and the filter's model too: the parameters that the scenario assumes, with the
    plant's Q and R, unless `filter_arguments` or a tuned file say otherwise.

    Raises:
        ValueError: for unknown names, a scenario of a linear plant, a tuned file of another filter than the arm's,
            or numbers out of range.
    """
    kind = plant_of(task)
    chosen = kind.tasks[task]
    arm, algorithm = find_arm(observe), find_algorithm(algo)
    kind.check_scenario(scenario)
    if arm.filter is None and (filter_arguments or tuned):
        raise ValueError(f"filter arguments must come with an arm that has a filter, but got {observe!r}")
    assumed = {name: value for name, value in plain(scenario.held).items() if value}
    given = {**arm.numbers, **assumed} if arm.filter is not None else {}
    if tuned is not None:
        content = read_tuned_file(tuned)
        found = content["filter"]
        one_of("filter of the tuned file", found["name"], (arm.filter,))
        scenario.check_tuned_for(content.get("plant"), tuned)
        given |= {**found["numbers"], **found["model"]}
    given |= filter_arguments or {}
    return Setup(
        observe=observe,
        algo=algo,
        task=task,
        scenario=scenario.name,
        env_id=chosen.env_id,
        env_arguments={**scenario.plant_arguments, **chosen.arguments},
        filter_arguments=given,
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


def in_scenario(setup: Setup, scenario: BaseScenario) -> Setup:
    """The same observation on another scenario's plant, of which a filter is not told.

    The filter goes on assuming the plant of the setup, whatever the scenario says of its errors.

    Raises:
        ValueError: for a scenario of another plant than the setup's, or a linear one.
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


def setup_from_json(text: str, name: str) -> Setup:
    """The inverse of `Setup.as_json`; `name` is that of the file, for errors.

    Raises:
        ValueError: if it is not the text of a setup, or one of a later version.
    """
    try:
        entries = json.loads(text)
        version = entries.pop("version")
        if version > VERSION:
            raise ValueError(f"{name} must be of version {VERSION} or before, but is of version {version}")
        if "assumed_plant" in entries:
            raise KeyError("assumed_plant")
    except (json.JSONDecodeError, RecursionError, TypeError, KeyError, AttributeError):
        raise ValueError(f"{name} must hold the setup of a policy, but got {shown(text)}") from None
    try:
        return Setup(**entries)
    except TypeError:  # an entry too many or too few
        raise ValueError(f"{name} must hold the setup of a policy, but got {shown(text)}") from None
    except ValueError as error:
        raise ValueError(f"{error} (in {name})") from None
