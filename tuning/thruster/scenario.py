"""`Scenario`: a named, seeded, immutable recipe that makes truth, inputs and measurements once for all filters."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, lru_cache
from pathlib import Path
from types import MappingProxyType

import numpy as np

from filters.bounds import posterior_bound
from numerics.checks import at_least, positive, shown, vector
from numerics.streams import episode_keys, filter_keys
from plants.state_space import StateSpaceModel
from thruster_env.channels import CHANNELS
from thruster_env.linear.analysis import equilibrium
from thruster_env.linear.linear_plant import make_linear_plant
from thruster_env.linear.steady_state import state_range
from thruster_env.model import model_of_plant
from thruster_env.plant import DEFAULT_DT, DEFAULT_MAX_VOLTAGE, DEFAULT_PROCESS_NOISE, Plant, make_plant
from thruster_env.plant_data import check_same_plant, plant_data
from thruster_env.simulation import simulate
from tuning.problems.data import FIRST_SCORED_STEP, Data
from tuning.problems.excitation import EXCITATIONS, Excitation, Steps
from tuning.problems.problem import Problem
from tuning.thruster.excitation import voltages_of

DEEPEST = 10  # levels of mappings and lists in a scenario
MOST_STEPS = 1_000_000
UNTUNED_RANGE_FRACTION = 0.01  # standard deviation of the untuned Q, as part of each state's range


@dataclass(frozen=True, kw_only=True)
class Scenario(Problem):
    """A plant, an excitation and what a filter assumes of the plant.

    A filter's model is the plant's, but for `parameter_factors`; it knows the distribution of the initial state
    and a constant `ambient_velocity`. Of sensor effects, `flow`, `amplifier` and `uncertainty` it knows nothing.

    Attributes:
        name: its name; that of its file if it was read from one.
        about: one line for tables and help.
        measurement_noise_cov: the plant's R, the variance of the sensor's sheet [N^2, or the channel's unit^2]; of
            several channels one each.
        process_noise_cov: the plant's Q, two variances a step [(rad/s)^2, (m/s)^2].
        scale: bound on the standard error of each state, (omega_m [rad/s], U_a [m/s]), of the scenario's Gaussian
            core: fixed numbers that errors are measured in, made by `scale.computed_scale`.
        parameter_factors: factors on the plant's parameters in the filter's model.
        excitation: makes the voltages; one of `excitation.EXCITATIONS`, or a mapping with its name.
        steps: length of a run.
        first_scored_step: where errors begin to count. Below 50 the start-up counts, too, and a study then tunes
            the scale of P_0.
        system: a published linear system that is the plant, "tunnel" or "open_bladed"; None for the equations.
        preset: the thruster, as for `thruster_env.plant.make_plant`; so are all that follow.
        dt: sample time [s].
        max_voltage: voltages are clipped to plus and minus this [V].
        ambient_velocity: constant flow U_0 [m/s].
        initial_state: None, two numbers, or a mapping.
        sensors: channels, a list of their names or a mapping from each to a list of effects.
        flow: list of signals.
        amplifier: list of effects.
        uncertainty: distributions of factors on parameters, drawn anew for each seed.
    """

    name: str
    about: str = ""
    process_noise_cov: tuple[float, float] = DEFAULT_PROCESS_NOISE
    measurement_noise_cov: float | Sequence[float] = CHANNELS["thrust"].variance
    scale: tuple[float, float]
    parameter_factors: Mapping[str, float] = field(default_factory=dict)
    excitation: Excitation | Mapping = field(default_factory=Steps)
    steps: int = 500
    first_scored_step: int = FIRST_SCORED_STEP
    system: str | None = None
    preset: str | Mapping = "tunnel"
    dt: float = DEFAULT_DT
    max_voltage: float = DEFAULT_MAX_VOLTAGE
    ambient_velocity: float = 0.0
    initial_state: Sequence | Mapping | None = None
    sensors: Sequence | Mapping = ("thrust",)
    flow: Sequence = ()
    amplifier: Sequence = ()
    uncertainty: Mapping = field(default_factory=dict)

    def __post_init__(self):
        """Check what the plant, which is made when it is needed, does not."""
        if not isinstance(self.excitation, Excitation):
            object.__setattr__(self, "excitation", EXCITATIONS.make([self.excitation])[0])
        for name, kind, called in (("about", str, "text"), ("parameter_factors", Mapping, "a mapping")):
            if not isinstance(getattr(self, name), kind):
                raise ValueError(f"{name} must be {called}, but got {shown(getattr(self, name))}")
        if isinstance(self.sensors, str) or not isinstance(self.sensors, Collection) or not self.sensors:
            raise ValueError(
                f"sensors of a scenario must be one channel or several, but got {shown(self.sensors)}"
            )
        scale = vector("scale", self.scale, 2)
        if not (scale > 0).all():
            raise ValueError(f"scale must be positive in every state, but got {scale.tolist()}")
        checked = {
            "process_noise_cov": vector("process_noise_cov", self.process_noise_cov, 2).tolist(),
            "measurement_noise_cov": _variances(self.measurement_noise_cov, len(self.sensors)),
            "scale": scale.tolist(),
            "steps": at_least("steps", self.steps, FIRST_SCORED_STEP + 1, MOST_STEPS),
            "first_scored_step": at_least("first_scored_step", self.first_scored_step, 0),
        }
        if checked["first_scored_step"] >= checked["steps"]:
            raise ValueError(
                f"first_scored_step must be below the number of steps, {self.steps}, "
                f"but got {self.first_scored_step}"
            )
        for entry in fields(self):
            object.__setattr__(self, entry.name, frozen(checked.get(entry.name, getattr(self, entry.name))))

    def __getstate__(self) -> dict:
        """The fields as dictionaries and lists, for copies and pickles: a mapping that cannot change has none."""
        return {entry.name: plain(getattr(self, entry.name)) for entry in fields(self)}

    def __setstate__(self, state: dict) -> None:
        """The fields, so that they cannot be changed again."""
        for name, value in state.items():
            object.__setattr__(self, name, frozen(value))

    @property
    def plant_arguments(self) -> dict:
        """Arguments of the env of the same plant, `BowThruster-v0`, or `BowThrusterLinear-v0` of a linear one."""
        own = {"name", "about", "scale", "parameter_factors", "excitation", "steps", "first_scored_step"}
        left_out = {"system"} if self.system is None else {"preset", "uncertainty"}
        names = [entry.name for entry in fields(self) if entry.name not in own | left_out]
        return {name: plain(getattr(self, name)) for name in names}

    @cached_property
    def plant(self) -> Plant:
        """The true plant."""
        return (make_plant if self.system is None else make_linear_plant)(**self.plant_arguments)

    def model(self, **changes) -> StateSpaceModel:
        """What the filter assumes; changes are arguments of `thruster_env.model.model_of_plant`."""
        return model_of_plant(self.plant, **{"parameter_factors": dict(self.parameter_factors), **changes})

    @property
    def untuned(self) -> dict:
        """Model arguments of the untuned filter: R from the sheet, Q from 1 % of each state's range."""
        deviation = UNTUNED_RANGE_FRACTION * _range(self.plant)
        return {
            "process_noise_cov": tuple(float(v) for v in deviation**2),
            "measurement_noise_cov": self.measurement_noise_cov,
        }

    @property
    def true(self) -> dict:
        """Model arguments of the filter that knows the plant's Q and R."""
        return {
            "process_noise_cov": self.process_noise_cov,
            "measurement_noise_cov": self.measurement_noise_cov,
        }

    @property
    def held(self) -> dict:
        """What the filter's model gets wrong of the plant's parameters."""
        return {"parameter_factors": dict(self.parameter_factors)}

    @property
    def plant_data(self) -> dict:
        """The plant as data, for comparison with an env's."""
        return plant_data(self.plant)

    def check_tuned_for(self, plant: Mapping | None, file: str | Path) -> None:
        """Raise ValueError if a tuned file is for another thruster, dt or sensor."""
        if plant is not None:
            check_same_plant(plant, self.plant, file)

    @property
    def counts_start_up(self) -> bool:
        """Whether the first steps count, in which P_0 is felt."""
        return self.first_scored_step < FIRST_SCORED_STEP

    @property
    def has_bound(self) -> bool:
        """Whether there is a posterior Cramér-Rao bound: its recursion needs the inverse of Q."""
        return bool(np.linalg.eigvalsh(self.plant.process_noise_cov)[0] > 0)

    @property
    def digest(self) -> str:
        """The first part of a SHA-256 of all that the scenario says but for its name and what it is about."""
        content = {entry.name: plain(getattr(self, entry.name)) for entry in fields(self)}
        content |= {"excitation": self.excitation.as_mapping(), "scale": [f"{part:.6g}" for part in self.scale]}
        del content["name"], content["about"]
        return hashlib.sha256(json.dumps(content, sort_keys=True, default=repr).encode()).hexdigest()[:12]

    def as_mapping(self) -> dict:
        """All that it says but for its name, as JSON can hold it; `files.scenario_of` reads it."""
        content = {
            entry.name: as_data(getattr(self, entry.name)) for entry in fields(self) if entry.name != "name"
        }
        return {**content, "excitation": self.excitation.as_mapping()}

    def replace(self, **changes) -> Scenario:
        """The same scenario with some fields changed."""
        return replace(self, **changes)

    def data(self, seeds: Sequence[int]) -> Data:
        """Truth, inputs and measurements for seeds; the same as an env's that is reset with these seeds."""
        return _data(self, tuple(int(seed) for seed in seeds))

    def bound(self, data: Data, truths: int = 100) -> np.ndarray:
        """Bound on the standard error of each state (2,), averaged over the data's inputs and scored steps.

        It is that of the scenario's Gaussian core: the nominal plant with the same Q, R and inputs, with no
        sensor effects, flow signals or amplifier. NaN where there is none.
        """
        if not self.has_bound:
            return np.full(2, np.nan)
        exact = model_of_plant(self.plant)
        variances = np.einsum("bkii->bki", posterior_bound(exact, data.inputs, truths=truths))
        return np.sqrt(variances[:, self.first_scored_step :].mean(axis=(0, 1)))

    def __hash__(self) -> int:
        return hash((self.name, self.process_noise_cov, self.measurement_noise_cov, self.excitation, self.steps))


@lru_cache(maxsize=8)
def _data(scenario: Scenario, seeds: tuple[int, ...]) -> Data:
    keys, plant = episode_keys(seeds), scenario.plant
    voltages = voltages_of(scenario.excitation, plant, keys, scenario.steps)
    voltages = np.clip(voltages, -plant.max_voltage, plant.max_voltage)  # as the env does
    simulation = simulate(plant, keys, voltages).checked(f"the plant of scenario {scenario.name}")
    measurements = np.where(simulation.valid, simulation.measurements, np.nan)  # as filters take missing ones
    return Data(
        seeds,
        voltages[..., None],
        measurements,
        filter_keys(seeds),
        scenario.first_scored_step,
        simulation.states,
        {"T": simulation.thrusts},
    ).read_only()


def _variances(given, channels: int) -> float | tuple[float, ...]:
    """R as a scenario holds it: one variance of one channel, or a variance for each of several."""
    if channels == 1 and not isinstance(given, list | tuple | np.ndarray):
        return positive("measurement_noise_cov", given)
    each = tuple(positive("measurement_noise_cov", v) for v in vector("measurement_noise_cov", given, channels))
    return each[0] if channels == 1 else each


def _range(plant: Plant) -> np.ndarray:
    """Range (2,) of the steady states over the voltage range."""
    if plant.linear is None:
        return state_range(plant.parameters, plant.max_voltage)
    ends = (equilibrium(plant.linear, (sign * plant.max_voltage, 0.0)) for sign in (1.0, -1.0))
    return np.abs(np.subtract(*ends))[:2]


def frozen(value, depth: int = 0):
    """A value of mappings and lists as one that cannot be changed; ValueError if it is nested without end."""
    if depth > DEEPEST:
        raise ValueError(f"mappings and lists must be nested at most {DEEPEST} deep, but got {shown(value)}")
    if isinstance(value, Mapping):
        return MappingProxyType({key: frozen(part, depth + 1) for key, part in value.items()})
    return tuple(frozen(part, depth + 1) for part in value) if isinstance(value, list | tuple) else value


def as_data(value):
    """As `plain`, with effects and parameters as mappings."""
    if hasattr(value, "_asdict"):
        return value._asdict()
    if hasattr(value, "as_mapping"):
        return value.as_mapping()
    if isinstance(value, Mapping):
        return {key: as_data(part) for key, part in value.items()}
    return [as_data(part) for part in value] if isinstance(value, list | tuple) else value


def plain(value):
    """The inverse of `frozen`: dictionaries and lists, which JSON and deep copies take."""
    if isinstance(value, Mapping):
        return {key: plain(part) for key, part in value.items()}
    return [plain(part) for part in value] if isinstance(value, list | tuple) else value
