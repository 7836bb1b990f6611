"""Policies on the underwater vehicle, which follows a path, or steps of the depth."""

from __future__ import annotations

import inspect
from collections.abc import Mapping

import numpy as np

from thruster_env.auv.channels import STATES
from thruster_env.auv.control import DepthAndCourse
from thruster_env.auv.env import SegorogeniAUVDepthEnv, SegorogeniAUVPathEnv
from thruster_env.auv.model import MODEL_ARGUMENTS, auv_model
from thruster_env.auv.plant import CRUISE_SPEED, Plant, make_plant
from thruster_env.env.commands import ObserveState
from thruster_env.model.state_space import StateSpaceModel
from tuning.auv.scenario import Scenario
from tuning.auv.scenarios import SCENARIOS, find_scenario
from tuning.policies.algorithms import LAYERS
from tuning.policies.observations import find_observation_set
from tuning.policies.plants.plant import Part, Task, TrainingPlant, part_of
from tuning.problems.scenario import BaseScenario

SHORTEST_STEP = 0.01  # [s]; with a shorter sample time the vehicle would hardly move in an episode
PD = "pd"


def _may_learn(scenario: Scenario) -> bool:
    return scenario.dt >= SHORTEST_STEP and scenario.states != "velocities"


class Vehicle(TrainingPlant):
    """The underwater vehicle."""

    tasks = {
        "path": Task("the papers' path IV, a climbing turn", "SegorogeniAUVPath-v0", {"path": "IV"}),
        "depth": Task("steps of 2 m up and down on a straight course", "SegorogeniAUVDepth-v0", {}),
    }
    scenario = "auv:navigation"
    scenarios = tuple(name for name, scenario_ in SCENARIOS.items() if _may_learn(scenario_))
    env_arguments = tuple(
        dict.fromkeys(
            name
            for env in (SegorogeniAUVPathEnv, SegorogeniAUVDepthEnv)
            for name in inspect.signature(env.__init__).parameters
            if name not in ("self", "render_mode")
        )
    )
    plant_arguments = tuple(inspect.signature(make_plant).parameters)
    model_arguments = MODEL_ARGUMENTS
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

    def find_scenario(self, name: str) -> Scenario:
        """A scenario of the vehicle by its name or file."""
        return find_scenario(name)

    def check_scenario(self, scenario: BaseScenario) -> None:
        """Raise ValueError unless a scenario is one of the vehicle, with attitude in its model."""
        if not isinstance(scenario, Scenario) or not _may_learn(scenario):
            rule = f"scenario must be the vehicle's, with roll and pitch as states and dt from {SHORTEST_STEP} s"
            raise ValueError(f"{rule}, but got {scenario.name!r}")

    def model(self, **arguments) -> StateSpaceModel:
        """What a filter assumes: `thruster_env.auv.model.auv_model`."""
        return auv_model(**arguments)

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

    def parts_of(self, recorded: np.ndarray, alive: np.ndarray, plant: Plant) -> dict[str, Part]:
        """Errors beside the path, below it, and of the speed against that of the cruise."""
        across, below, speed = recorded
        return {
            "cross-track": part_of(across, alive),
            "vertical": part_of(below, alive),
            "speed": part_of(speed - CRUISE_SPEED, alive),
        }


AUV = Vehicle()
