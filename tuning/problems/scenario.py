"""`PlantScenario`: a problem that is plain data, an immutable recipe that files store completely."""

from __future__ import annotations

import hashlib
import json
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar, Self

import gymnasium as gym
import numpy as np

from thruster_env.core.checks import at_least, short_repr, vector
from thruster_env.env.env import as_json
from thruster_env.model.state_space import StateSpaceModel
from tuning.problems.assumed import RANGE_FRACTION
from tuning.problems.data import FIRST_SCORED_STEP, Data, checked_first_scored_step
from tuning.problems.excitation import Excitation, Steps, excitation_of
from tuning.problems.problem import BOUND, GIVEN, Problem

DEEPEST = 10  # levels of mappings and lists
OF_SCENARIO = "name", "about", "scale", "parameter_factors", "excitation", "steps", "first_scored_step"  # fields
MOST_STEPS = 1_000_000
FILE_SEQUENCES = 200  # input sequences for the scale of a file that gives none


def frozen(value, depth: int = 0):
    """Mappings and lists as an immutable value; ValueError if they are nested too deep."""
    if depth > DEEPEST:
        raise ValueError(f"mappings and lists must be nested at most {DEEPEST} deep, but got {short_repr(value)}")
    if isinstance(value, Mapping):
        return MappingProxyType({key: frozen(part, depth + 1) for key, part in value.items()})
    return tuple(frozen(part, depth + 1) for part in value) if isinstance(value, list | tuple) else value


def plain(value):
    """The inverse of `frozen`: dictionaries and lists, for JSON and deep copies."""
    if isinstance(value, Mapping):
        return {key: plain(part) for key, part in value.items()}
    return [plain(part) for part in value] if isinstance(value, list | tuple) else value


@dataclass(frozen=True, kw_only=True)
class PlantScenario(Problem):
    """What the scenarios of all plants have in common; the subclass of a plant adds the fields of this plant.

    A subclass is a frozen dataclass of plain data whose further fields are arguments of the plant's env. It checks
    them in `own_checks`, makes its data in `make`, and has `state_ranges`, from which the untuned Q follows.

    Attributes:
        plant_kind: key of its plant in `find.plant_packages`.
        of_plant: the module with `make_plant`, `plant_data` and `check_same_plant` of the plant.
        model_of_plant: a function of the plant and changes that makes the model.
        scale_sequences: input sequences for the scale of a built-in scenario.
        name: its name; that of its file if it was read from one.
        about: one line for tables and help.
        scale: by which the score divides the error of each state, fixed numbers; None for 1.
        process_noise_cov: the plant's Q, one variance per step for each state; covariances do not scale with dt.
        measurement_noise_cov: the plant's R, one variance for each channel.
        parameter_factors: factors on the plant's parameters in the filter's model.
        excitation: makes the inputs; one of `excitation.EXCITATIONS`, or a mapping with its name.
        steps: length of a run.
        first_scored_step: the first step whose error is scored. Below 50 the start-up is scored, too, and a study
            then tunes the scale of P_0.
    """

    plant_kind: ClassVar[str]
    of_plant: ClassVar[Any]
    model_of_plant: ClassVar[Callable[..., StateSpaceModel]]
    scale_sequences: ClassVar[int] = FILE_SEQUENCES
    name: str
    about: str = ""
    scale: Sequence[float] | None
    process_noise_cov: Sequence[float]
    measurement_noise_cov: float | Sequence[float] | None
    parameter_factors: Mapping[str, float] = field(default_factory=dict)
    excitation: Excitation = field(default_factory=Steps)
    steps: int = 500
    first_scored_step: int = FIRST_SCORED_STEP

    def __post_init__(self):
        """Check the fields that are not checked when the plant is made."""
        object.__setattr__(self, "excitation", excitation_of(self.excitation))
        for name, kind, called in (("about", str, "text"), ("parameter_factors", Mapping, "a mapping")):
            if not isinstance(getattr(self, name), kind):
                raise ValueError(f"{name} must be {called}, but got {short_repr(getattr(self, name))}")
        checked = self.own_checks() | {"steps": at_least("steps", self.steps, FIRST_SCORED_STEP + 1, MOST_STEPS)}
        checked["first_scored_step"] = checked_first_scored_step(self.first_scored_step, checked["steps"])
        for entry in fields(self):
            object.__setattr__(self, entry.name, frozen(checked.get(entry.name, getattr(self, entry.name))))

    def own_checks(self) -> dict:
        """Fields of the plant and `scale` as they are to be stored; ValueError for wrong ones."""
        raise NotImplementedError

    def make(self, seeds: tuple[int, ...]) -> Data:
        """The data of some seeds; `data` caches the last ones."""
        raise NotImplementedError

    def checked_scale(self, states: int) -> list[float]:
        """The scale as one positive number a state, 1 if it is None; ValueError for another."""
        scale = np.ones(states) if self.scale is None else vector("scale", self.scale, states)
        if not (scale > 0).all():
            raise ValueError(f"scale must be positive in every state, but got {scale.tolist()}")
        return scale.tolist()

    def __getstate__(self) -> dict:
        """The fields as dictionaries and lists, for copies and pickles: immutable mappings cannot be pickled."""
        return {entry.name: plain(getattr(self, entry.name)) for entry in fields(self)}

    def __setstate__(self, state: dict) -> None:
        """Set the fields, immutable again."""
        for name, value in state.items():
            object.__setattr__(self, name, frozen(value))

    def __hash__(self) -> int:
        return hash((self.name, self.process_noise_cov, self.measurement_noise_cov, self.excitation, self.steps))

    @property
    @abstractmethod
    def env_id(self) -> str:
        """The env of the same plant."""

    @property
    def not_of_env(self) -> tuple[str, ...]:
        """Fields beyond those of all scenarios that are no arguments of this env."""
        return ()

    @property
    @abstractmethod
    def state_ranges(self) -> np.ndarray:
        """Range of each of the model's states, (n,)."""

    def computed_scale(self, sequences: int) -> np.ndarray:
        """The scale (n,), by default the bound over input sequences of the seeds 0, 1, 2, ...; not this one's own.

        Raises:
            ValueError: if it is zero or not finite, as it is without any noise.
        """
        scale = self.bound(self.data(range(at_least("sequences", sequences, 1))))
        if not (np.isfinite(scale).all() and (scale > 0).all()):
            raise ValueError(f"scale must be positive in every state, but the bound is {scale.tolist()}")
        return scale

    @property
    def plant_arguments(self) -> dict:
        """Arguments of this env that make the same plant."""
        names = [entry.name for entry in fields(self) if entry.name not in (*OF_SCENARIO, *self.not_of_env)]
        return {name: plain(getattr(self, name)) for name in names}

    @cached_property
    def plant(self) -> Any:
        """The true plant."""
        return self.of_plant.make_plant(**self.plant_arguments)

    def model(self, **changes) -> StateSpaceModel:
        """What the filter assumes; changes are arguments of `model_of_plant`."""
        return type(self).model_of_plant(self.plant, **{**self.held, **changes})

    @property
    def plant_data(self) -> dict:
        """The plant as data, for comparison with an env's."""
        return self.of_plant.plant_data(self.plant)

    def check_tuned_for(self, plant: Mapping | None, file: str | Path) -> None:
        """Raise ValueError if a tuned file is for another plant, dt or sensors."""
        if plant is not None:
            self.of_plant.check_same_plant(plant, self.plant, file)

    @property
    def untuned(self) -> dict:
        """Model arguments of the untuned filter: R from the data sheets, Q from 1 % of each state's range."""
        deviation = RANGE_FRACTION * self.state_ranges
        return {
            "process_noise_cov": tuple(float(v) for v in deviation**2),
            "measurement_noise_cov": self.measurement_noise_cov,
        }

    @property
    def scale_about(self) -> str:
        """A description of the scale, which a file may set freely."""
        return GIVEN if self.name.endswith(".toml") else self.computed_scale_about

    @property
    def computed_scale_about(self) -> str:
        """A description of the scale where it is computed."""
        return BOUND

    @property
    def true(self) -> dict:
        """Model arguments of the filter that knows the plant's Q and R."""
        return {"process_noise_cov": self.process_noise_cov, "measurement_noise_cov": self.measurement_noise_cov}

    @property
    def held(self) -> dict:
        """Where the model differs from the plant in every choice: its wrong parameters."""
        return {"parameter_factors": dict(self.parameter_factors)}

    @property
    def counts_start_up(self) -> bool:
        """Whether the first steps are scored, on which P_0 has an effect."""
        return self.first_scored_step < FIRST_SCORED_STEP

    @property
    def digest(self) -> str:
        """The first part of a SHA-256 of all fields but `name` and `about`."""
        content = {entry.name: plain(getattr(self, entry.name)) for entry in fields(self)}
        content |= {
            "excitation": self.excitation.as_mapping(),
            "scale": [f"{part:.6g}" for part in self.scale or ()],
        }
        del content["name"], content["about"]
        return hashlib.sha256(json.dumps(content, sort_keys=True, default=repr).encode()).hexdigest()[:12]

    def as_mapping(self) -> dict:
        """All fields but the name, for JSON; `tuning.problems.find.scenario_of` reads it."""
        content = {
            entry.name: as_json(getattr(self, entry.name)) for entry in fields(self) if entry.name != "name"
        }
        return {"plant": self.plant_kind, **content, "excitation": self.excitation.as_mapping()}

    def make_env(self, **arguments: Any) -> gym.Env:
        """An env of the scenario's plant, as `gym.make` makes it, with the scenario's length.

        Filters with this env assume the plant itself; the scenario's assumptions are in a tuned file, or

            EstimateState(scenario.make_env(), "ekf", model_arguments=dict(scenario.held))

        Args:
            **arguments: of the env, in place of those of the plant; or of `gym.make`.
        """
        return gym.make(self.env_id, **{"max_episode_steps": self.steps, **self.plant_arguments, **arguments})

    def replace(self, **changes) -> Self:
        """The same scenario with some fields changed."""
        return replace(self, **changes)

    def data(self, seeds: Sequence[int]) -> Data:
        """Truth, inputs and measurements for seeds; the same as an env's that is reset with these seeds."""
        return _data(self, tuple(int(seed) for seed in seeds))


@lru_cache(maxsize=8)
def _data(scenario: PlantScenario, seeds: tuple[int, ...]) -> Data:
    return scenario.make(seeds).read_only()


def print_scales(scenarios: Mapping[str, PlantScenario], names: Sequence[str]) -> None:
    """Print computed and stored scales of scenarios, all of them if none is named."""
    for name in names or scenarios:
        scenario = scenarios[name]
        scale = tuple(float(f"{part:.4g}") for part in scenario.computed_scale(scenario.scale_sequences))
        print(f"{name}: {scale}, stored {scenario.scale}", flush=True)
