"""Policies on the thruster, whose thrust follows a reference."""

from __future__ import annotations

import inspect
from collections.abc import Mapping

import numpy as np

from thruster_env.model.state_space import StateSpaceModel
from thruster_env.thruster.control.planning import HORIZONS
from thruster_env.thruster.env import BowThrusterEnv
from thruster_env.thruster.model import MODEL_ARGUMENTS, thruster_model
from thruster_env.thruster.plant import Plant, make_plant
from thruster_env.thruster.task import thrust_scale
from tuning.policies.plants.plant import Part, Task, TrainingPlant, part_of
from tuning.problems.scenario import BaseScenario
from tuning.thruster.scenario import Scenario
from tuning.thruster.scenarios import SCENARIOS, find_scenario

TRANSIENT = 0.15  # [s] after a step of the reference; later steps are steady tracking
STEP_OF_REFERENCE = 0.02  # least change within one sample time that is a step [T_max]
FIRST_SCORED_STEP = 50  # of the RMSE of the observed thrust, as for all estimates


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

    def check_scenario(self, scenario: BaseScenario) -> None:
        """Raise ValueError unless a scenario is one of the thruster's equations."""
        if not isinstance(scenario, Scenario) or scenario.system is not None:
            kind = "linear" if isinstance(scenario, Scenario) else "of another plant"
            raise ValueError(f"scenario must be one of the thruster's equations, but {scenario.name!r} is {kind}")

    def model(self, **arguments) -> StateSpaceModel:
        """What a filter assumes: `thruster_env.thruster.model.thruster_model`."""
        return thruster_model(**arguments)

    def classical(self, name: str, env, training_returns):
        """PI, LQR, or a predictive controller."""
        from tuning.policies.plants.thruster_controllers import controller_of

        return controller_of(name, env, training_returns)

    def corrected(self, name: str, env):
        """A predictive controller."""
        from tuning.policies.plants.thruster_controllers import predictive

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
