"""Policies on the underwater vehicle: they follow a path, or steps of the depth."""

from __future__ import annotations

import inspect
from collections.abc import Mapping

import numpy as np

from auv_env.control.depth_and_course import DepthAndCourse
from auv_env.model import MODEL_ARGUMENTS, auv_model
from auv_env.plant import CRUISE_SPEED, Plant, make_plant
from auv_env.tasks import SegorogeniAUVDepthEnv, SegorogeniAUVPathEnv
from plants.state_space import StateSpaceModel
from training.observations import find_arm
from training.plants.plant import Part, Task, TrainingPlant, part_of
from tuning.auv.find import find_scenario
from tuning.auv.scenario import Scenario
from tuning.auv.scenarios import SCENARIOS

SHORTEST_STEP = 0.01  # [s]; with shorter ones an episode would have no time to go anywhere
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
    scenarios = tuple(name for name, one in SCENARIOS.items() if _may_learn(one))
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
    parts = {"cross-track": "m", "vertical": "m", "speed": "m/s"}
    errors = "of the true place beside and above the path, and of the speed"

    def find_scenario(self, name: str) -> Scenario:
        """A scenario of the vehicle by its name or file."""
        return find_scenario(name)

    def check_scenario(self, scenario: Scenario) -> None:
        """Raise ValueError unless a scenario is one of the vehicle, with attitude in its model."""
        if not isinstance(scenario, Scenario) or not _may_learn(scenario):
            rule = f"scenario must be the vehicle's, with roll and pitch as states and dt from {SHORTEST_STEP} s"
            raise ValueError(f"{rule}, but got {scenario.name!r}")

    def model(self, **arguments) -> StateSpaceModel:
        """What a filter assumes: `auv_env.model.auv_model`."""
        return auv_model(**arguments)

    def classical(self, name: str, setup):
        """PD on depth and course, from measurements, from an estimate or from the true state."""
        from training.controllers import ClassicalPolicy
        from training.environments import make_single

        arm, env = find_arm(setup.observe), make_single(setup)
        if arm.pairs or arm.form != "estimate":
            raise ValueError(f"{PD} must observe measurements or a state, but got observe={setup.observe!r}")
        seen = "measurement"
        if arm.shows_state:
            seen = "navigation" if arm.is_true or env.env.filter.model.n == 12 else "motion"
        low, high = env.unwrapped.plant.input_limits
        return ClassicalPolicy(DepthAndCourse.for_env(env, seen), 0, (high - low) / 2, (high + low) / 2)

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
