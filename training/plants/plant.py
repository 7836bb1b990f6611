"""`TrainingPlant`: what training has to know of a plant, its tasks, envs, models and controllers."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np

from plants.state_space import StateSpaceModel
from training.observations import find_arm
from tuning.problems.scenario import BaseScenario

if TYPE_CHECKING:
    import gymnasium as gym

    from training.controllers import ClassicalPolicy
    from training.setup import Setup


class Task(NamedTuple):
    """An env and what it is asked to follow."""

    about: str
    env_id: str
    arguments: dict


class Part(NamedTuple):
    """Squared errors of episodes, summed over some of their steps."""

    squares: np.ndarray  # (B,), in the unit of the error, squared
    steps: np.ndarray  # (B,)

    @property
    def rms(self) -> float:
        """Root of the mean square, pooled over episodes; NaN if no step counts."""
        steps = self.steps.sum()
        return float(np.sqrt(self.squares.sum() / steps)) if steps else float("nan")


def part_of(errors: np.ndarray, chosen: np.ndarray) -> Part:
    """Errors (B, K) over the chosen steps (B, K)."""
    return Part((np.where(chosen, errors, 0.0) ** 2).sum(axis=1), chosen.sum(axis=1))


class TrainingPlant(ABC):
    """A plant on which policies learn; what they observe is that of `training.observations` for all plants.

    Attributes:
        tasks: by name, which no other plant has.
        scenario: name of the one that is the default.
        scenarios: names of those that policies may learn in.
        env_arguments: names of those of its envs, `render_mode` left out.
        plant_arguments: names of those that say what the plant is, and not what is asked of it.
        model_arguments: names of what a filter may assume otherwise.
        output: symbol of the output that stands in front of a state that is observed; None for none.
        controllers: names of the classical policies.
        of_states: those of them that must observe a state.
        correctable: those that a policy may correct.
        hyperparameters: of algorithms by name, where they differ from those of `training.algorithms`.
        parts: what `parts_of` gives, with units.
        errors: what these are errors of, in words.
    """

    tasks: ClassVar[Mapping[str, Task]]
    scenario: ClassVar[str]
    scenarios: ClassVar[tuple[str, ...]]
    env_arguments: ClassVar[tuple[str, ...]]
    plant_arguments: ClassVar[tuple[str, ...]]
    model_arguments: ClassVar[tuple[str, ...]]
    output: ClassVar[str | None] = None
    controllers: ClassVar[tuple[str, ...]]
    of_states: ClassVar[tuple[str, ...]]
    correctable: ClassVar[tuple[str, ...]] = ()
    hyperparameters: ClassVar[Mapping[str, Mapping]] = {}
    parts: ClassVar[Mapping[str, str]]
    errors: ClassVar[str]

    @abstractmethod
    def find_scenario(self, name: str) -> BaseScenario:
        """A scenario by its name or file; ValueError for one of another plant."""

    @abstractmethod
    def check_scenario(self, scenario: BaseScenario) -> None:
        """Raise ValueError for a scenario in which no policy can learn, or of another plant."""

    @abstractmethod
    def model(self, **arguments) -> StateSpaceModel:
        """What a filter assumes, of arguments of the plant and of the model."""

    def check_observes(self, name: str, observe: str) -> None:
        """Raise ValueError unless a classical policy can act on what an arm observes."""
        if name in self.of_states and not find_arm(observe).shows_state:
            raise ValueError(f"{name} must observe a state, but got observe={observe!r}")

    @abstractmethod
    def classical(self, name: str, setup: Setup) -> ClassicalPolicy:
        """A classical policy for what a setup observes."""

    def corrected(self, name: str, env: gym.Env) -> ClassicalPolicy:
        """The controller that a policy corrects, by one of the names `correctable`."""
        raise NotImplementedError

    @abstractmethod
    def recorded(self, arrays: Mapping[str, np.ndarray], observations: np.ndarray) -> tuple[np.ndarray, ...]:
        """What `parts_of` needs of a step: infos of B copies, one row each, and observations after it (B, d)."""

    @abstractmethod
    def parts_of(self, recorded: np.ndarray, alive: np.ndarray, plant: Any) -> dict[str, Part]:
        """Errors of episodes by name, from what was recorded (q, B, K) and whether an episode went on (B, K)."""
