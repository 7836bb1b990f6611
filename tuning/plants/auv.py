"""The underwater vehicle's scenarios: `Scenario`, a named, seeded and immutable recipe, and the built-in ones.

    python -m tuning.plants.auv [NAME ...]

recomputes their scales and prints them.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from filters.bounds import path_bound, wrapped_variances
from thruster_env.auv import plant as plants
from thruster_env.auv.equations import simulate
from thruster_env.auv.model import MODELS, model_of_plant, state_range
from thruster_env.auv.paths import MANOEUVRES
from thruster_env.auv.plant import (
    ATTITUDES,
    DEFAULT_DT,
    DEFAULT_MAX_THRUST,
    DEFAULT_PROCESS_NOISE,
    DEFAULT_PROPELLER_TORQUE,
    EULER,
    MAX_CHANNELS,
    STATES,
    Plant,
    make_plant,
)
from thruster_env.core.checks import one_of, positive, short_repr, vector
from thruster_env.core.streams import episode_keys, filter_keys
from thruster_env.effects.effects import set_field
from thruster_env.model.turns import tangent_of
from tuning.problems.data import Data
from tuning.problems.excitation import EXCITATIONS, Excitation, Levels
from tuning.problems.find import find_in
from tuning.problems.problem import PATH_BOUND
from tuning.problems.scenario import PlantScenario, print_scales

TORQUE = 1  # index of K_prop among the inputs of a manoeuvre
RUNS_AT_ONCE = 16  # runs whose covariances of all steps are in memory at the same time
PLANE = math.radians(6.0)
SAILING = Levels(low=(2.0, -PLANE, -PLANE), high=(4.0, PLANE, PLANE), shortest=60, longest=160)
"""Thrusts of 2 to 4 N and planes within 6 deg, each held for 3 to 8 s."""
MINUTE: dict[str, Any] = {"excitation": SAILING, "steps": 1200, "first_scored_step": 100}
DVL = ("u", "v", "w")


@EXCITATIONS.register("manoeuvre")
@dataclass(frozen=True)
class OfManoeuvre(Excitation):
    """Thrust and planes of one of the vehicle's manoeuvres, the same for every seed; the last values are held."""

    path: str = "IV"

    def __post_init__(self):
        """Check the arguments."""
        set_field(self, "path", one_of("path", self.path, tuple(MANOEUVRES)))

    def inputs(self, keys: np.ndarray, steps: int, dt: float, count: int) -> np.ndarray:
        """Inputs (B, steps, count): with the propeller's torque if there are four of them, without if three."""
        if count not in (3, 4):
            raise ValueError(
                f"the excitation 'manoeuvre' must be a vehicle's, with 3 or 4 inputs, but got {count}"
            )
        manoeuvre = MANOEUVRES[self.path]
        times = np.minimum((np.arange(steps) + 0.5) * dt, manoeuvre.duration)
        each = np.array([manoeuvre.inputs(time) for time in times.tolist()])
        each = each if count == 4 else np.delete(each, TORQUE, axis=1)
        return np.broadcast_to(each, (len(keys), *each.shape)).copy()


def commands_of(excitation: Excitation, plant: Plant, keys: np.ndarray, steps: int) -> np.ndarray:
    """Thrust, the torque where it is an input, and planes (B, steps, p), clipped to the limits of the env."""
    low, high = plant.input_limits
    return np.clip(excitation.inputs(keys, steps, plant.dt, len(plant.inputs)), low, high)


@dataclass(frozen=True, kw_only=True)
class Scenario(PlantScenario):
    """A vehicle, an excitation and what a filter assumes of the vehicle.

    A filter's model has the first of the twelve states; it is the vehicle's model, except for `parameter_factors`,
    and knows the distribution of the initial state. It does not know the sensor effects; the current is among the
    states of "current", and unknown to the other models.

    Attributes, beside those of `PlantScenario`:
        process_noise_cov: the vehicle's Q, twelve variances per step; they do not scale with `dt`.
        measurement_noise_cov: the vehicle's R, one variance for each channel; those of the data sheets if None.
        scale: of each of the model's states, the standard deviation by the Riccati equation along the noise-free
            path: fixed numbers, from `computed_scale`.
        states: those of the model, "velocities" (6), "motion" (8), "navigation" (12) or "current" (14). With
            "velocities" roll and pitch are inputs, true ones.
        preset: the vehicle, as for `thruster_env.auv.plant.make_plant`; so are all that follow.
        dt: sample time [s].
        propeller_torque: divided by thrust [m]; None makes the torque an input.
        initial_state: None, twelve numbers, or a mapping.
        sensors: a suite's name, channels, or a mapping from them to lists of effects.
        current: three velocities [m/s], or signals by direction.
        propeller_lag: time constant of the thrust [s], unknown to filters.
        plane_lag: time constant of both planes [s], unknown to filters.
        max_thrust: thrusts are clipped to 0 and this [N].
        attitude: "euler", or "quaternion" for a `Rotation` in the place of roll, pitch and yaw: "motion" has then
            9 errors, and "navigation" 12, of which the scale is.
    """

    plant_kind = "auv"
    of_plant: ClassVar[Any] = plants
    model_of_plant = staticmethod(model_of_plant)
    env_id = "thruster_env.auv:SegorogeniAUV-v0"
    not_of_env = ("states",)
    process_noise_cov: Sequence[float] = DEFAULT_PROCESS_NOISE
    measurement_noise_cov: Sequence[float] | None = None
    states: str = "motion"
    preset: str | Mapping = "segorogeni"
    dt: float = DEFAULT_DT
    propeller_torque: float | None = DEFAULT_PROPELLER_TORQUE
    initial_state: Sequence | Mapping | None = None
    sensors: str | Sequence | Mapping = "motion"
    current: Sequence | Mapping = field(default_factory=dict)
    propeller_lag: float = 0.0
    plane_lag: float = 0.0
    max_thrust: float = DEFAULT_MAX_THRUST
    attitude: str = EULER

    __hash__ = PlantScenario.__hash__

    def own_checks(self) -> dict:
        """Noise, and the scale of the model's states."""
        one_of("attitude", self.attitude, ATTITUDES)
        known = tuple(MODELS) if self.attitude == EULER else ("motion", "navigation")
        one_of("states" if self.attitude == EULER else "states of an attitude 'quaternion'", self.states, known)
        checked = {
            "scale": self.checked_scale(self.count),
            "process_noise_cov": vector("process_noise_cov", self.process_noise_cov, len(STATES)).tolist(),
        }
        variances = self.measurement_noise_cov
        if variances is None:  # those of the instruments, so that the scenario lists them
            checked["measurement_noise_cov"] = np.diag(
                make_plant(sensors=self.sensors, attitude=self.attitude).measurement_noise_cov
            ).tolist()
            return checked
        if not isinstance(variances, list | tuple) or not 1 <= len(variances) <= MAX_CHANNELS:
            rule = f"measurement_noise_cov must be 1 to {MAX_CHANNELS} variances, one for each channel"
            raise ValueError(f"{rule}, but got {short_repr(variances)}")
        return checked | {"measurement_noise_cov": [positive("measurement_noise_cov", v) for v in variances]}

    @property
    def count(self) -> int:
        """Number of errors of the model's state: n, but 9 of "motion" with a quaternion, which has yaw."""
        return max(MODELS[self.states].count, 6 if self.attitude == EULER else 9)

    @property
    def held(self) -> dict:
        """Where the model differs from the vehicle in every choice: its states, and wrong parameters."""
        return {"states": self.states, **super().held}

    @property
    def state_ranges(self) -> np.ndarray:
        """Range (n,) of each state: forwards up to the largest speed, else to either side."""
        return np.where(np.arange(self.count) == 0, 1.0, 2.0) * state_range(self.plant, self.count)

    @property
    def true(self) -> dict:
        """Model arguments of the filter that knows the vehicle's Q and R."""
        of_vehicle = tuple(self.process_noise_cov[: self.count])
        of_current = np.diag(model_of_plant(self.plant, states=self.states).process_noise_cov)[len(STATES) :]
        return {**super().true, "process_noise_cov": (*of_vehicle, *of_current.tolist())}

    @property
    def computed_scale_about(self) -> str:
        """A description of the scale where it is computed."""
        return PATH_BOUND

    def bound(self, data: Data) -> np.ndarray:
        """Standard deviation of each state (n,) by the Riccati equation along noise-free paths, over scored steps.

        It is that of the nominal vehicle with the same Q, R and inputs, and with the same missing measurements as
        the data. `posterior_bound` would be useless here, because angles and positions have hardly any process
        noise.
        """
        exact, missing = model_of_plant(self.plant, states=self.states), np.isnan(data.seen.measurements)
        total, scored, inputs = np.zeros(exact.t), data.scored, data.seen.inputs
        angles = [error.angle for error in tangent_of(exact)]
        for first in range(0, len(data.seeds), RUNS_AT_ONCE):
            block = slice(first, first + RUNS_AT_ONCE)
            covs = path_bound(exact, inputs[block], missing[block])
            covs = covs[:, data.late] if data.counted is None else covs[scored[block]][None]
            variances = np.einsum("bkii->bki", covs)
            total = total + wrapped_variances(variances, angles).sum(axis=(0, 1))
        return np.sqrt(total / scored.sum())

    def make(self, seeds: tuple[int, ...]) -> Data:
        """Truth and measurements under the excitation's thrusts and planes."""
        keys, plant = episode_keys(seeds), self.plant
        commands = commands_of(self.excitation, plant, keys, self.steps)
        simulation = simulate(plant, keys, commands).checked(f"the plant of scenario {self.name}")
        inputs = commands
        if self.states == "velocities":
            inputs = np.concatenate([commands, simulation.states[:, :-1, 6:8]], axis=2)
        all_states = np.concatenate([simulation.states, simulation.current], axis=2)
        model = self.model()
        states = np.ascontiguousarray(all_states[..., : model.n])
        outputs = {symbol: model.output(symbol, states) for symbol in model.outputs}
        measurements = np.where(simulation.valid, simulation.measurements, np.nan)  # NaN: missing
        return Data(seeds, inputs, measurements, filter_keys(seeds), self.first_scored_step, states, outputs)


PAPERS: dict[str, Any] = {
    "sensors": "papers",
    "dt": 0.001,
    "process_noise_cov": (1e-6,) * 6 + (1e-12,) * 6,
    "initial_state": {"mean": [0.0] * 12, "cov": [[1e-6 * (i == j) for j in range(12)] for i in range(12)]},
    "excitation": OfManoeuvre("IV"),
    "steps": 5000,
    "first_scored_step": 2000,
}


def suite_with(name: str, channels: tuple[str, ...], effect: dict) -> dict[str, list[dict]]:
    """Sensors of a suite, with one more effect on some channels, as a scenario takes them."""
    effects = make_plant(sensors=name).sensors.items()
    return {
        channel: [*(before.as_mapping() for before in chain), *([effect] if channel in channels else [])]
        for channel, chain in effects
    }


# Standard deviations by the Riccati equation for 200 input sequences, to one per cent; a test recomputes some.
MOTION_SCALE = (0.007873, 0.004605, 0.005282, 0.002202, 0.002147, 0.002115, 0.0005593, 0.0009131)
NAVIGATION_SCALE = (
    0.007821,
    0.004604,
    0.005248,
    0.002202,
    0.002146,
    0.002115,
    0.000559,
    0.0009114,
    0.00178,
    0.03492,
    0.03428,
    0.004844,
)
CURRENT = {
    direction: [{"name": "gauss-markov", "std": 0.2, "time_constant": 60.0}] for direction in ("north", "east")
}
SCENARIOS: dict[str, Scenario] = {
    scenario.name: scenario
    for scenario in (
        Scenario(
            name="auv:motion",
            about="velocities by DVL, rates by gyros, roll and pitch by AHRS, and a perfect model",
            scale=MOTION_SCALE,
            **MINUTE,
        ),
        Scenario(
            name="auv:papers",
            about="the published noise at 1 kHz on path IV: u, v, w and r to 1 mm/s, attitude not measured",
            scale=(0.0007861, 0.0007861, 0.0007861, 0.01703, 0.02112, 0.000786, 0.002553, 0.01423),
            **PAPERS,
        ),
        Scenario(
            name="auv:papers_20hz",
            about="the published sensors at 20 Hz: u, v, w and r to 1 mm/s, attitude not measured",
            sensors="papers",
            scale=(0.0009238, 0.0009228, 0.000923, 0.004209, 0.004884, 0.0009219, 0.0005931, 0.003052),
            **MINUTE,
        ),
        Scenario(
            name="auv:velocities",
            about="the papers' six states at 20 Hz, roll and pitch from an ideal sensor",
            states="velocities",
            sensors="papers",
            scale=(0.0009238, 0.0009228, 0.000923, 0.004031, 0.004871, 0.0009219),
            **MINUTE,
        ),
        Scenario(
            name="auv:navigation",
            about="DVL, gyros, AHRS, compass and depth: position by dead reckoning",
            states="navigation",
            sensors="default",
            scale=NAVIGATION_SCALE,
            **MINUTE,
        ),
        Scenario(
            name="auv:loop",
            about="over the top: full thrust, nose up, with a quaternion and directions of gravity and field",
            states="navigation",
            sensors="vectors",
            attitude="quaternion",
            max_thrust=8.0,
            excitation=Levels(low=(7.0, -0.26, 0.0), high=(8.0, -0.25, 0.0), shortest=60, longest=160),
            steps=600,
            first_scored_step=100,
            scale=(
                0.005464,
                0.004079,
                0.004273,
                0.002325,
                0.002198,
                0.002109,
                0.001813,
                0.0009658,
                0.001057,
                0.01515,
                0.01503,
                0.004473,
            ),
        ),
        Scenario(
            name="auv:usbl",
            about="the same with an acoustic position fix (USBL) every 2 s",
            states="navigation",
            sensors="usbl",
            scale=(
                0.007821,
                0.004604,
                0.005248,
                0.002202,
                0.002146,
                0.002115,
                0.000559,
                0.0009114,
                0.00178,
                0.03413,
                0.03354,
                0.004844,
            ),
            **MINUTE,
        ),
        Scenario(
            name="auv:no_dvl",
            about="gyros, AHRS, compass and depth: the speed follows from the model",
            states="navigation",
            sensors="inertial",
            scale=(
                0.01024,
                0.004744,
                0.005473,
                0.002205,
                0.002154,
                0.002119,
                0.0005762,
                0.0009233,
                0.001787,
                0.06397,
                0.05409,
                0.005417,
            ),
            **MINUTE,
        ),
        Scenario(
            name="auv:dvl_dropout",
            about="the DVL loses bottom track half of the time, for 10 s on average",
            states="navigation",
            sensors=suite_with("default", DVL, {"name": "dropout", "probability": 0.5, "mean_length": 200}),
            scale=(
                0.009044,
                0.004674,
                0.005361,
                0.002204,
                0.00215,
                0.002117,
                0.0005676,
                0.0009172,
                0.001784,
                0.04411,
                0.0432,
                0.005127,
            ),
            **MINUTE,
        ),
        Scenario(
            name="auv:dvl_outliers",
            about="one DVL velocity in twenty has an error of about 0.2 m/s",
            sensors=suite_with("motion", DVL, {"name": "outliers", "std": 0.2, "probability": 0.05}),
            scale=MOTION_SCALE,
            **MINUTE,
        ),
        Scenario(
            name="auv:wrong_drag",
            about="the filter assumes half of the drag ahead and 20 % more drag across",
            parameter_factors={"Xuu": 0.5, "Yvv": 1.2, "Zww": 1.2, "Yuv": 1.2, "Zuw": 1.2},
            scale=MOTION_SCALE,
            **MINUTE,
        ),
        Scenario(
            name="auv:current",
            about="a slowly changing current of about 0.2 m/s north and east, unknown to the filter",
            states="navigation",
            sensors="default",
            current=CURRENT,
            scale=NAVIGATION_SCALE,
            **MINUTE,
        ),
        Scenario(
            name="auv:estimated_current",
            about="the same current, estimated as two further states of the filter's model",
            states="current",
            sensors="default",
            current=CURRENT,
            scale=(
                0.009718,
                0.009672,
                0.006036,
                0.00252,
                0.002223,
                0.00218,
                0.0006729,
                0.0009328,
                0.001792,
                0.0536,
                0.0539,
                0.005383,
                0.02306,
                0.02347,
            ),
            **MINUTE,
        ),
    )
}


# The vehicle's scenarios by name or file, for `tuning.problems.find`.
NOMINAL = "auv:motion"


def find_scenario(name: str) -> Scenario:
    """A scenario by its name, or from a file that ends in .toml; ValueError for another."""
    return find_in(SCENARIOS, Scenario, name)


if __name__ == "__main__":
    print_scales(SCENARIOS, sys.argv[1:])
