"""`Scenario`: a named, seeded, immutable recipe for an underwater vehicle, made once for all filters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property
from pathlib import Path

import numpy as np

from filters.bounds import path_bound
from filters.wrapped import wrapped_variances
from thruster_env.auv.channels import MAX_CHANNELS, STATES
from thruster_env.auv.engine.simulation import simulate
from thruster_env.auv.model import MODELS, model_of_plant, state_range
from thruster_env.auv.paths import MANOEUVRES
from thruster_env.auv.plant import (
    DEFAULT_DT,
    DEFAULT_PROCESS_NOISE,
    DEFAULT_PROPELLER_TORQUE,
    Plant,
    check_same_plant,
    make_plant,
    plant_data,
)
from thruster_env.core.checks import at_least, one_of, positive, short_repr, vector
from thruster_env.core.streams import episode_keys, filter_keys
from thruster_env.effects.effects import set_field
from thruster_env.model.state_space import StateSpaceModel
from tuning.problems.data import Data
from tuning.problems.excitation import EXCITATIONS, Excitation
from tuning.problems.problem import GIVEN, PATH_BOUND
from tuning.problems.scenario import BaseScenario, plain

# Inputs of the vehicle's scenarios: any excitation of thrust and planes, and the manoeuvres of the papers.


TORQUE = 1  # index of K_prop among the inputs of a manoeuvre


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


UNTUNED_RANGE_FRACTION = 0.01  # standard deviation of the untuned Q, as a fraction of each state's range
RUNS_AT_ONCE = 16  # runs whose covariances of all steps are in memory at the same time


@dataclass(frozen=True, kw_only=True)
class Scenario(BaseScenario):
    """A vehicle, an excitation and what a filter assumes of the vehicle.

    A filter's model has the first of the twelve states; it is the vehicle's model, except for `parameter_factors`,
    and knows the distribution of the initial state. It does not know the sensor effects; the current is among the
    states of "current", and unknown to the other models.

    Attributes, beside those of `BaseScenario`:
        process_noise_cov: the vehicle's Q, twelve variances per step; they do not scale with `dt`.
        measurement_noise_cov: the vehicle's R, one variance for each channel; those of the data sheets if None.
        scale: of each of the model's states, the standard deviation by the Riccati equation along the noise-free
            path: fixed numbers, computed by `scale.computed_scale`.
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
    """

    plant_kind = "auv"
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

    __hash__ = BaseScenario.__hash__

    def own_checks(self) -> dict:
        """Noise, and the scale of the model's states."""
        one_of("states", self.states, tuple(MODELS))
        checked = {
            "scale": self.checked_scale(self.count),
            "process_noise_cov": vector("process_noise_cov", self.process_noise_cov, len(STATES)).tolist(),
        }
        variances = self.measurement_noise_cov
        if variances is None:  # those of the instruments, so that the scenario lists them
            checked["measurement_noise_cov"] = np.diag(
                make_plant(sensors=self.sensors).measurement_noise_cov
            ).tolist()
            return checked
        if not isinstance(variances, list | tuple) or not 1 <= len(variances) <= MAX_CHANNELS:
            rule = f"measurement_noise_cov must be 1 to {MAX_CHANNELS} variances, one for each channel"
            raise ValueError(f"{rule}, but got {short_repr(variances)}")
        return checked | {"measurement_noise_cov": [positive("measurement_noise_cov", v) for v in variances]}

    @property
    def count(self) -> int:
        """Number n of the model's states."""
        return MODELS[self.states].count

    @property
    def env_id(self) -> str:
        """`SegorogeniAUV-v0`."""
        return "thruster_env.auv:SegorogeniAUV-v0"

    @property
    def plant_arguments(self) -> dict:
        """Arguments of the env of the same vehicle, `SegorogeniAUV-v0`."""
        of_scenario = {
            "name",
            "about",
            "scale",
            "parameter_factors",
            "excitation",
            "steps",
            "first_scored_step",
            "states",
        }
        names = [entry.name for entry in fields(self) if entry.name not in of_scenario]
        return {name: plain(getattr(self, name)) for name in names}

    @cached_property
    def plant(self) -> Plant:
        """The true vehicle."""
        return make_plant(**self.plant_arguments)

    def model(self, **changes) -> StateSpaceModel:
        """What the filter assumes; changes are arguments of `thruster_env.auv.model.model_of_plant`."""
        fixed = {"states": self.states, "parameter_factors": dict(self.parameter_factors) or None}
        return model_of_plant(self.plant, **{**fixed, **changes})

    @property
    def held(self) -> dict:
        """Where the model differs from the vehicle in every choice: its states, and wrong parameters."""
        return {"states": self.states, **super().held}

    @property
    def plant_data(self) -> dict:
        """The vehicle as data, for comparison with an env's."""
        return plant_data(self.plant)

    def check_tuned_for(self, plant: Mapping | None, file: str | Path) -> None:
        """Raise ValueError if a tuned file is for another vehicle, dt or sensors."""
        if plant is not None:
            check_same_plant(plant, self.plant, file)

    @property
    def untuned(self) -> dict:
        """Model arguments of the untuned filter: R from the data sheets, Q from 1 % of each state's range."""
        top = state_range(self.plant, self.count)
        deviation = UNTUNED_RANGE_FRACTION * np.where(np.arange(self.count) == 0, 1.0, 2.0) * top
        return {
            "process_noise_cov": tuple(float(v) for v in deviation**2),
            "measurement_noise_cov": self.measurement_noise_cov,
        }

    @property
    def true(self) -> dict:
        """Model arguments of the filter that knows the vehicle's Q and R."""
        of_vehicle = tuple(self.process_noise_cov[: self.count])
        of_current = np.diag(model_of_plant(self.plant, states=self.states).process_noise_cov)[len(STATES) :]
        return {**super().true, "process_noise_cov": (*of_vehicle, *of_current.tolist())}

    @property
    def scale_about(self) -> str:
        """A description of the scale, which a file may set freely."""
        return GIVEN if self.name.endswith(".toml") else PATH_BOUND

    def bound(self, data: Data) -> np.ndarray:
        """Standard deviation of each state (n,) by the Riccati equation along noise-free paths, over scored steps.

        It is that of the nominal vehicle with the same Q, R and inputs, and with the same missing measurements as
        the data. `posterior_bound` would be useless here, because angles and positions have hardly any process
        noise.
        """
        exact, missing = model_of_plant(self.plant, states=self.states), np.isnan(data.seen.measurements)
        total, scored, inputs = np.zeros(exact.n), data.scored, data.seen.inputs
        for first in range(0, len(data.seeds), RUNS_AT_ONCE):
            block = slice(first, first + RUNS_AT_ONCE)
            covs = path_bound(exact, inputs[block], missing[block])
            covs = covs[:, data.late] if data.counted is None else covs[scored[block]][None]
            variances = np.einsum("bkii->bki", covs)
            total = total + wrapped_variances(variances, exact.shape.state_angles).sum(axis=(0, 1))
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
        states = np.ascontiguousarray(all_states[..., : self.count])
        model = self.model()
        outputs = {symbol: model.output(symbol, states) for symbol in model.outputs}
        measurements = np.where(simulation.valid, simulation.measurements, np.nan)  # NaN: missing
        return Data(seeds, inputs, measurements, filter_keys(seeds), self.first_scored_step, states, outputs)


# The scale of a vehicle's scenario: standard deviations by the Riccati equation along noise-free paths.


SEQUENCES = 200  # input sequences for a stored scale


def computed_scale(scenario: Scenario, sequences: int = SEQUENCES) -> np.ndarray:
    """The scale (n,) of a scenario, its bound over the seeds 0, 1, 2, ...

    Raises:
        ValueError: if it is zero or not finite, as it is without any noise.
    """
    scale = scenario.bound(scenario.data(range(at_least("sequences", sequences, 1))))
    if not (np.isfinite(scale).all() and (scale > 0).all()):
        raise ValueError(f"scale must be positive in every state, but the bound is {scale.tolist()}")
    return scale
