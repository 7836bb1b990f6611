"""`TrainingPlant`: a plant for training, with its tasks, envs, models and controllers."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np

from thruster_env.model.state_space import StateSpaceModel
from tuning.policies.observations import find_observation_set
from tuning.problems.scenario import BaseScenario

if TYPE_CHECKING:
    import gymnasium as gym

    from tuning.policies.controllers import ClassicalPolicy


# Returns (copies, episodes) of so many copies of a policy, stepped side by side, on the same training seeds.
TrainingReturns = Callable[["ClassicalPolicy", int, int], np.ndarray]


class Task(NamedTuple):
    """An env with its reference or path."""

    about: str
    env_id: str
    arguments: dict


class Part(NamedTuple):
    """Squared errors of episodes, summed over some of their steps."""

    squares: np.ndarray  # (B,), in the unit of the error, squared
    steps: np.ndarray  # (B,)

    @property
    def rms(self) -> float:
        """Root mean square error, pooled over episodes; NaN without any step."""
        steps = self.steps.sum()
        return float(np.sqrt(self.squares.sum() / steps)) if steps else float("nan")


def part_of(errors: np.ndarray, chosen: np.ndarray) -> Part:
    """Errors (B, K) over the chosen steps (B, K)."""
    return Part((np.where(chosen, errors, 0.0) ** 2).sum(axis=1), chosen.sum(axis=1))


class TrainingPlant(ABC):
    """A plant on which policies learn; `tuning.policies.observations` has the sets for all.

    Attributes:
        tasks: tasks by name; no two plants share a name.
        scenario: name of the default scenario.
        scenarios: names of the scenarios in which policies may learn.
        env_arguments: names of the envs' arguments, without `render_mode`.
        plant_arguments: names of the arguments of the plant, without those of the task.
        model_arguments: names of arguments in which a filter's model may differ from the plant.
        output: symbol of the output that precedes an observed state; None for none.
        controllers: names of the classical policies.
        of_states: names of those that must observe a state.
        correctable: names of those that a policy may correct.
        hyperparameters: hyperparameters by algorithm, where they differ from those of
            `tuning.policies.algorithms`.
        parts: names and units of the errors of `parts_of`.
        errors: description of these errors.
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
        """The model that a filter assumes, from arguments of the plant and of the model."""

    def check_observes(self, name: str, observe: str) -> None:
        """Raise ValueError unless a classical policy can act on an observation set."""
        if name in self.of_states and not find_observation_set(observe).shows_state:
            raise ValueError(f"{name} must observe a state, but got observe={observe!r}")

    @abstractmethod
    def classical(self, name: str, env: gym.Wrapper, training_returns: TrainingReturns) -> ClassicalPolicy:
        """A classical policy for the observations of an env, from `make_single`; its gains may be tried out."""

    def corrected(self, name: str, env: gym.Env) -> ClassicalPolicy:
        """The controller that a policy corrects, by one of the names `correctable`."""
        raise NotImplementedError

    @abstractmethod
    def recorded(self, arrays: Mapping[str, np.ndarray], observations: np.ndarray) -> tuple[np.ndarray, ...]:
        """The values of a step for `parts_of`, from infos of B copies and the observations after it (B, d)."""

    @abstractmethod
    def parts_of(self, recorded: np.ndarray, alive: np.ndarray, plant: Any) -> dict[str, Part]:
        """Errors of episodes by name, from recorded values (q, B, K) and whether an episode continues (B, K)."""
