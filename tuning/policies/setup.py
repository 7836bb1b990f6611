"""`TrainingConfiguration`: everything that a policy is trained with, as plain data.

It is read from a policy's folder, which may come from another person. So every entry is checked here before it
reaches Gymnasium, a filter or Stable-Baselines3, and before any other file is opened.
"""

from __future__ import annotations

import inspect
import json
import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import gymnasium as gym
import numpy as np

from filters.registry import filter_type
from filters.tuned_file import AUGMENTED, read_tuned_file
from thruster_env.auv.env import SegorogeniAUVDepthEnv, SegorogeniAUVPathEnv
from thruster_env.auv.model import MODEL_ARGUMENTS as AUV_MODEL_ARGUMENTS
from thruster_env.auv.model import auv_model
from thruster_env.auv.paths import DepthAndCourse
from thruster_env.auv.plant import CRUISE_SPEED, EULER, STATES
from thruster_env.auv.plant import Plant as VehiclePlant
from thruster_env.auv.plant import make_plant as make_vehicle
from thruster_env.core.checks import at_least, one_of, positive, short_repr
from thruster_env.env.env import ObserveState
from thruster_env.model.state_space import StateSpaceModel
from thruster_env.thruster.controllers import HORIZONS
from thruster_env.thruster.env import BowThrusterEnv
from thruster_env.thruster.model import MODEL_ARGUMENTS, thruster_model
from thruster_env.thruster.plant import Plant, make_plant, thrust_scale
from tuning.plants.auv import SCENARIOS as VEHICLE_SCENARIOS
from tuning.plants.auv import Scenario as VehicleScenario
from tuning.plants.auv import find_scenario as find_vehicle_scenario
from tuning.plants.thruster import SCENARIOS, Scenario, find_scenario
from tuning.policies.algorithms import (
    HYPERPARAMETERS,
    LAYERS,
    POLICY_ARGUMENTS,
    TrainingReturns,
    find_algorithm,
    find_observation_set,
)
from tuning.policies.controllers import lqr, pi, predictive
from tuning.problems.scenario import PlantScenario, plain

if TYPE_CHECKING:
    from tuning.policies.controllers import ClassicalPolicy


# Plants on which policies learn: their tasks, envs, models and controllers.
#
# The thruster's thrust follows a reference; the underwater vehicle follows a path, or steps of the depth.


TRANSIENT = 0.15  # [s] after a step of the reference; later steps are steady tracking
STEP_OF_REFERENCE = 0.02  # least change within one sample time that is a step [T_max]
FIRST_SCORED_STEP = 50  # of the RMSE of the observed thrust, as for all estimates
SHORTEST_STEP = 0.01  # [s]; with a shorter sample time the vehicle would hardly move in an episode
PD = "pd"


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
    """A plant on which policies learn; `tuning.policies.setup` has the sets for all.

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
    def find_scenario(self, name: str) -> PlantScenario:
        """A scenario by its name or file; ValueError for one of another plant."""

    @abstractmethod
    def check_scenario(self, scenario: PlantScenario) -> None:
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


class Thruster(TrainingPlant):
    """The bow thruster."""

    tasks = {
        "tracking": Task("steps of thrust ahead, as the env has them", "BowThrusterTracking-v0", {}),
        "reversal": Task("ramps of thrust through zero, as the env has them", "BowThrusterReversal-v0", {}),
        "manoeuvre": Task(
            "steps of thrust ahead and astern, every half second",
            "BowThrusterTracking-v0",
            {"reference": [{"name": "steps", "low": -0.6, "high": 0.6, "hold_time": 0.5}]},
        ),
    }
    scenario = "medium_noise"
    scenarios = tuple(name for name, scenario in SCENARIOS.items() if scenario.system is None)
    env_arguments = tuple(
        name
        for name in inspect.signature(BowThrusterEnv.__init__).parameters
        if name not in ("self", "render_mode")
    )
    plant_arguments = tuple(inspect.signature(make_plant).parameters)
    model_arguments = MODEL_ARGUMENTS
    output = "T"
    controllers = ("pi", "lqr", *HORIZONS)
    of_states = controllers[1:]
    correctable = tuple(HORIZONS)
    parts = dict.fromkeys(("all", "transient", "steady", "reversal", "observed"), "N")
    errors = "of thrust; seen: of the thrust that the policy observes"

    def find_scenario(self, name: str) -> Scenario:
        """A scenario of the thruster by its name or file."""
        return find_scenario(name)

    def check_scenario(self, scenario: PlantScenario) -> None:
        """Raise ValueError unless a scenario is one of the thruster's equations."""
        if not isinstance(scenario, Scenario) or scenario.system is not None:
            kind = "linear" if isinstance(scenario, Scenario) else "of another plant"
            raise ValueError(f"scenario must be one of the thruster's equations, but {scenario.name!r} is {kind}")

    def model(self, **arguments) -> StateSpaceModel:
        """What a filter assumes: `thruster_env.thruster.model.thruster_model`."""
        return thruster_model(**arguments)

    def classical(self, name: str, env, training_returns):
        """PI, LQR, or a predictive controller."""
        return controller_of(name, env, training_returns)

    def corrected(self, name: str, env):
        """A predictive controller."""
        from tuning.policies.controllers import predictive

        return predictive(name, env)

    def recorded(self, arrays: Mapping[str, np.ndarray], observations: np.ndarray) -> tuple[np.ndarray, ...]:
        """The true thrust, the reference, and the thrust that the policy observes [N]."""
        return arrays["thrust"].copy(), arrays["reference"].copy(), observations[:, 0].astype(np.float64)

    def parts_of(self, recorded: np.ndarray, alive: np.ndarray, plant: Plant) -> dict[str, Part]:
        """Errors of thrust [N]: over all steps, soon after steps of the reference, elsewhere, at reversals.

        "observed" is the error of the thrust that the policy observes.
        """
        thrusts, references, observed = recorded
        transient, reversal = _windows(
            references, STEP_OF_REFERENCE * thrust_scale(plant), round(TRANSIENT / plant.dt)
        )
        errors, late = thrusts - references, np.arange(alive.shape[1]) >= FIRST_SCORED_STEP
        return {
            "all": part_of(errors, alive),
            "transient": part_of(errors, alive & transient),
            "steady": part_of(errors, alive & ~transient),
            "reversal": part_of(errors, alive & reversal),
            "observed": part_of(observed - thrusts, alive & late),
        }


def _windows(references: np.ndarray, least: float, length: int) -> tuple[np.ndarray, np.ndarray]:
    """Steps (B, K) soon after the reference steps, and soon after its sign changes."""
    before = np.concatenate([np.zeros_like(references[:, :1]), references[:, :-1]], axis=1)
    stepped = np.abs(references - before) > least
    crossed = references * before < 0
    return _soon_after(stepped, length), _soon_after(crossed, length)


def _soon_after(events: np.ndarray, length: int) -> np.ndarray:
    """Whether one of the last `length` steps, this one included, had an event."""
    count = np.cumsum(events, axis=1)
    past = np.pad(count, ((0, 0), (length, 0)))[:, : events.shape[1]]
    return count > past


THRUSTER = Thruster()


def _may_learn(scenario: VehicleScenario) -> bool:
    return scenario.dt >= SHORTEST_STEP and scenario.states != "velocities" and scenario.attitude == EULER


class Vehicle(TrainingPlant):
    """The underwater vehicle."""

    tasks = {
        "path": Task("the papers' path IV, a climbing turn", "SegorogeniAUVPath-v0", {"path": "IV"}),
        "depth": Task("steps of 2 m up and down on a straight course", "SegorogeniAUVDepth-v0", {}),
    }
    scenario = "auv:navigation"
    scenarios = tuple(name for name, scenario_ in VEHICLE_SCENARIOS.items() if _may_learn(scenario_))
    env_arguments = tuple(
        dict.fromkeys(
            name
            for env in (SegorogeniAUVPathEnv, SegorogeniAUVDepthEnv)
            for name in inspect.signature(env.__init__).parameters
            if name not in ("self", "render_mode")
        )
    )
    plant_arguments = tuple(inspect.signature(make_vehicle).parameters)
    model_arguments = AUV_MODEL_ARGUMENTS
    controllers = (PD,)
    of_states = ()
    correctable = (PD,)
    # A turn takes seconds, so the horizon is 5 s; with large random actions the vehicle would tumble.
    hyperparameters = {
        "ppo": {"gamma": 0.99, "gae_lambda": 0.95, "policy_kwargs": {**LAYERS, "log_std_init": -2.0}},
        "sac": {"gamma": 0.98},
        "td3": {"gamma": 0.98},
        "recurrent-ppo": {"gamma": 0.99, "gae_lambda": 0.95},
    }
    parts = {"cross-track": "m", "vertical": "m", "speed": "m/s"}
    errors = "of the true place beside and above the path, and of the speed"

    def find_scenario(self, name: str) -> VehicleScenario:
        """A scenario of the vehicle by its name or file."""
        return find_vehicle_scenario(name)

    def check_scenario(self, scenario: PlantScenario) -> None:
        """Raise ValueError unless a scenario is one of the vehicle, with attitude in its model."""
        if not isinstance(scenario, VehicleScenario) or not _may_learn(scenario):
            rule = "scenario must be the vehicle's, with roll and pitch, no quaternion, as states"
            raise ValueError(f"{rule} and dt from {SHORTEST_STEP} s, but got {scenario.name!r}")

    def model(self, **arguments) -> StateSpaceModel:
        """What a filter assumes: `thruster_env.auv.model.auv_model`, of a plant whose attitude is Euler's."""
        of_plant = {name: value for name, value in arguments.items() if (name, value) != ("attitude", EULER)}
        return auv_model(**of_plant)

    def check_observes(self, name: str, observe: str) -> None:
        """Raise ValueError for a history, or a belief with standard deviations."""
        observed = find_observation_set(observe)
        if observed.pairs or observed.form != "estimate":
            raise ValueError(f"{name} must observe measurements or a state, but got observe={observe!r}")

    def classical(self, name: str, env, training_returns):
        """PD control of depth and course, from measurements, from an estimate or from the true state."""
        return self.corrected(name, env.env)

    def corrected(self, name: str, env):
        """The same for an env with a filter, or `ObserveState`, as its outermost wrapper, if it has one."""
        from tuning.policies.controllers import ClassicalPolicy

        source = "navigation" if isinstance(env, ObserveState) else "measurement"
        if (filter_ := getattr(env, "filter", None)) is not None:
            source = "navigation" if filter_.model.n == len(STATES) else "motion"
        low, high = env.unwrapped.plant.input_limits
        return ClassicalPolicy(DepthAndCourse.for_env(env, source), 0, (high - low) / 2, (high + low) / 2)

    def recorded(self, arrays: Mapping[str, np.ndarray], observations: np.ndarray) -> tuple[np.ndarray, ...]:
        """True errors beside the path and below it [m], and the speed u [m/s]."""
        return *arrays["path_errors"].T.copy(), arrays["state"][:, 0].copy()

    def parts_of(self, recorded: np.ndarray, alive: np.ndarray, plant: VehiclePlant) -> dict[str, Part]:
        """Errors beside the path, below it, and of the speed against that of the cruise."""
        across, below, speed = recorded
        return {
            "cross-track": part_of(across, alive),
            "vertical": part_of(below, alive),
            "speed": part_of(speed - CRUISE_SPEED, alive),
        }


AUV = Vehicle()

PLANTS: dict[str, TrainingPlant] = {"thruster": THRUSTER, "vehicle": AUV}
TASKS = {name: task for plant in PLANTS.values() for name, task in plant.tasks.items()}


def plant_of(task: str) -> TrainingPlant:
    """The plant of a task's name; ValueError for an unknown one."""
    one_of("task", task, tuple(TASKS))
    return next(plant for plant in PLANTS.values() if task in plant.tasks)


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
        observe: name of an observation set, see `tuning.policies.setup`.
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


def controller_of(name: str, env: gym.Wrapper, training_returns: TrainingReturns) -> ClassicalPolicy:
    """A classical policy of the thruster by name; arguments as of `TrainingPlant.classical`."""
    if name in HORIZONS:
        return predictive(name, env.env)
    return lqr(env) if name == "lqr" else pi(env, training_returns)
