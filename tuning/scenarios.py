"""Scenarios: named, seeded, immutable recipes that make truth, inputs and measurements once for all filters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from filters.bounds import posterior_bound
from filters.model import StateSpaceModel
from filters.thruster import model_of_plant
from thruster_env.checks import at_least, one_of
from thruster_env.linear import state_range
from thruster_env.plant import DEFAULT_MEASUREMENT_NOISE, DEFAULT_PROCESS_NOISE, Plant, make_plant
from thruster_env.simulation import simulate
from thruster_env.streams import EXCITATION, episode_keys, filter_keys, uniform_block

FIRST_SCORED_STEP = 50  # RMSE counts steps 50 to 500; start-up is reported apart
UNTUNED_ENSEMBLE_SIZE = 30
UNTUNED_RANGE_FRACTION = 0.01  # standard deviation of the untuned Q, as part of each state's range
SEEDS_APART = 1_000_000  # training seeds of study seed s start at s times this, held-out seeds half-way on


class Data(NamedTuple):
    """What a scenario makes for B seeds and K steps."""

    seeds: tuple[int, ...]
    inputs: np.ndarray  # (B, K, 1) [V]
    states: np.ndarray  # (B, K + 1, 2)
    thrusts: np.ndarray  # (B, K + 1) [N]
    measurements: np.ndarray  # (B, K + 1, 1) [N], NaN where missing
    filter_keys: np.ndarray  # (B, 2)


@dataclass(frozen=True, kw_only=True)
class Scenario:
    """A plant, an excitation and what the filter assumes of the plant.

    Attributes:
        name: its name.
        about: one line for tables and help.
        process_noise_cov: the plant's Q, two variances a step.
        measurement_noise_cov: the plant's R [N^2]; the sensor's sheet states it.
        scale: bound on the standard error of each state, (omega_m [rad/s], U_a [m/s]), of the scenario's Gaussian
            core: fixed numbers that errors are measured in.
        parameter_factors: factors on the plant's parameters in the filter's model.
        amplitude: the voltage is held at levels uniform in plus and minus this [V] ...
        hold: ... for so many steps each.
        steps: length of a run.
    """

    name: str
    about: str
    process_noise_cov: tuple[float, float]
    measurement_noise_cov: float
    scale: tuple[float, float]
    parameter_factors: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))
    amplitude: float = 12.0
    hold: int = 25
    steps: int = 500

    @cached_property
    def plant(self) -> Plant:
        """The true plant."""
        return make_plant(
            process_noise_cov=self.process_noise_cov, measurement_noise_cov=self.measurement_noise_cov
        )

    def model(self, **changes) -> StateSpaceModel:
        """What the filter assumes; changes are arguments of `filters.thruster.model_of_plant`."""
        return model_of_plant(self.plant, **{"parameter_factors": dict(self.parameter_factors), **changes})

    @property
    def untuned(self) -> dict:
        """Model arguments of the untuned filter: R from the sheet, Q from 1 % of each state's range."""
        deviation = UNTUNED_RANGE_FRACTION * state_range(self.plant.parameters, self.plant.max_voltage)
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

    def data(self, seeds: Sequence[int]) -> Data:
        """Truth, inputs and measurements for seeds; the same as an env's that is reset with these seeds."""
        return _data(self, tuple(int(seed) for seed in seeds))

    def bound(self, data: Data, truths: int = 100) -> np.ndarray:
        """Bound on the standard error of each state (2,), averaged over the data's inputs and scored steps."""
        exact = model_of_plant(self.plant)
        variances = np.einsum("bkii->bki", posterior_bound(exact, data.inputs, truths=truths))
        return np.sqrt(variances[:, FIRST_SCORED_STEP:].mean(axis=(0, 1)))

    def __hash__(self) -> int:
        return hash((self.name, self.process_noise_cov, self.measurement_noise_cov, self.amplitude, self.hold))


@lru_cache(maxsize=8)
def _data(scenario: Scenario, seeds: tuple[int, ...]) -> Data:
    keys = episode_keys(seeds)
    voltages = held_levels(keys, scenario.amplitude, scenario.hold, scenario.steps)
    simulation = simulate(scenario.plant, keys, voltages)
    measurements = np.where(simulation.valid, simulation.measurements, np.nan)  # as filters take missing ones
    truth = simulation.states, simulation.thrusts
    data = Data(seeds, voltages[..., None], *truth, measurements, filter_keys(seeds))
    for array in data[1:]:
        array.setflags(write=False)
    return data


def held_levels(keys: np.ndarray, amplitude: float, hold: int, steps: int) -> np.ndarray:
    """Voltages (B, steps) [V]: levels uniform within plus and minus amplitude, each held for `hold` steps."""
    level = np.arange(steps)[None, :] // hold
    u, *_ = uniform_block(0, level, EXCITATION, keys[:, :1], keys[:, 1:])
    return amplitude * (2.0 * u - 1.0)


def training_seeds(seed: int, count: int) -> range:
    """Seeds that a study with a given seed learns from."""
    first = at_least("seed", seed, 0) * SEEDS_APART
    return range(first, first + at_least("the number of training seeds", count, 2))


def held_out_seeds(seed: int, count: int) -> range:
    """Seeds that a study with a given seed never sees."""
    first = at_least("seed", seed, 0) * SEEDS_APART + SEEDS_APART // 2
    return range(first, first + at_least("the number of held-out seeds", count, 2))


# Bounds from 1200 input sequences and 100 truths each; a test computes them anew.
NOMINAL_SCALE = (1.0753, 0.0464)

SCENARIOS: dict[str, Scenario] = {
    scenario.name: scenario
    for scenario in (
        Scenario(
            name="nominal",
            about="a perfect model and small noise: every good filter sits on the bound",
            process_noise_cov=DEFAULT_PROCESS_NOISE,
            measurement_noise_cov=DEFAULT_MEASUREMENT_NOISE,
            scale=NOMINAL_SCALE,
        ),
        Scenario(
            name="published_noise",
            about="the noise of the published experiments on the nonlinear plant: filters differ",
            process_noise_cov=(0.5, 0.5),
            measurement_noise_cov=0.5,
            scale=(0.8069, 0.0720),
        ),
        Scenario(
            name="mismatch",
            about="the filter believes in 15 % more lift and 5 % less voltage gain K2 than there is",
            process_noise_cov=DEFAULT_PROCESS_NOISE,
            measurement_noise_cov=DEFAULT_MEASUREMENT_NOISE,
            scale=NOMINAL_SCALE,
            parameter_factors=MappingProxyType({"lift_coefficient": 1.15, "voltage_gain": 0.95}),
        ),
    )
}


def find_scenario(name: str) -> Scenario:
    """A scenario by name; ValueError for an unknown one."""
    return SCENARIOS[one_of("scenario", name, tuple(SCENARIOS))]
