"""`Setup`: all that a policy was trained with, as one value that JSON can hold."""

from __future__ import annotations

import inspect
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import NamedTuple

from filters.registry import read_tuned_file
from thruster_env.checks import at_least, one_of, positive, shown
from thruster_env.plant import make_plant
from thruster_env.predictive import HORIZONS
from training.algorithms import find_algorithm
from training.arms import find_arm
from tuning.scenario import Scenario, plain

VERSION = 1
SHARE = 0.2  # of the maximum voltage, by which a policy may correct a controller


class Task(NamedTuple):
    """An env and what it is asked to follow."""

    about: str
    env_id: str
    arguments: dict


TASKS: dict[str, Task] = {
    "tracking": Task("steps of thrust ahead, as the env has them", "BowThrusterTracking-v0", {}),
    "reversal": Task("ramps of thrust through zero, as the env has them", "BowThrusterReversal-v0", {}),
    "manoeuvre": Task(
        "steps of thrust ahead and astern, every half second",
        "BowThrusterTracking-v0",
        {"reference": [{"name": "steps", "low": -0.6, "high": 0.6, "hold_time": 0.5}]},
    ),
}


@dataclass(frozen=True, kw_only=True)
class Setup:
    """What is learnt, from what, by what.

    Attributes:
        observe: name of an arm, see `training.arms`.
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
        share: the largest correction [V_max].
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

    def as_json(self) -> str:
        """The setup as text."""
        return json.dumps({"version": VERSION, **asdict(self)}, indent=2) + "\n"

    def differences(self, other: Setup) -> list[str]:
        """Names of what differs, apart from the steps: a longer run goes on where a shorter one ended."""
        names = [entry.name for entry in fields(self) if entry.name != "steps"]
        return [name for name in names if getattr(self, name) != getattr(other, name)]


def make_setup(
    task: str,
    scenario: Scenario,
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
    chosen = TASKS[one_of("task", task, tuple(TASKS))]
    arm, algorithm = find_arm(observe), find_algorithm(algo)
    _check_plant(scenario)
    if controller is not None:
        one_of("controller", controller, tuple(HORIZONS))
        if not arm.shows_state:
            raise ValueError(f"{controller} must observe a state, but got observe={observe!r}")
    if arm.filter is None and (filter_arguments or tuned):
        raise ValueError(f"filter arguments must come with an arm that has a filter, but got {observe!r}")
    assumed = {"parameter_factors": plain(scenario.parameter_factors)} if scenario.parameter_factors else {}
    given = {**arm.numbers, **assumed} if arm.filter is not None else {}
    if tuned is not None:
        found = read_tuned_file(tuned)["filter"]
        one_of("filter of the tuned file", found["name"], (arm.filter,))
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
        steps=at_least("steps", algorithm.steps if steps is None else steps, 1),
        seed=at_least("seed", seed, 0),
        num_envs=at_least("num_envs", algorithm.num_envs if num_envs is None else num_envs, 1),
        hyperparameters={**algorithm.hyperparameters, **(hyperparameters or {})},
        controller=controller,
        share=positive("share", share),
    )


def in_scenario(setup: Setup, scenario: Scenario) -> Setup:
    """The same observation on another scenario's plant, of which a filter is not told.

    The filter goes on assuming the plant of the setup, whatever the scenario says of its errors.

    Raises:
        ValueError: for a scenario of a linear plant.
    """
    _check_plant(scenario)
    of_plant = inspect.signature(make_plant).parameters
    plant = {name: value for name, value in setup.env_arguments.items() if name in of_plant}
    task = {name: value for name, value in setup.env_arguments.items() if name not in of_plant}
    assumed = setup.filter_arguments
    if find_arm(setup.observe).filter is not None:
        assumed = {"model": "filters.thruster:thruster_model", **plant, **assumed}
    return replace(
        setup,
        scenario=scenario.name,
        env_arguments={**scenario.plant_arguments, **task},
        filter_arguments=assumed,
    )


def _check_plant(scenario: Scenario) -> None:
    if scenario.system is not None:
        raise ValueError(f"scenario must be one of the thruster's equations, but {scenario.name!r} is linear")


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
        return Setup(**entries)
    except (json.JSONDecodeError, TypeError, KeyError, AttributeError):
        raise ValueError(f"{name} must hold the setup of a policy, but got {shown(text)}") from None
