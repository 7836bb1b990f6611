"""How soon a monitor finds faults: delays on the thruster and the vehicle, beside the best test for each bias."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import NamedTuple

import numpy as np

from filters.engine.batch import run
from filters.filter import Filter
from filters.monitoring import TESTS, Monitor, cusum_run_length, cusum_threshold
from filters.registry import make_filter
from thruster_env.core.streams import filter_keys
from thruster_env.core.text_tables import markdown_table
from thruster_env.model.simulate import simulate
from thruster_env.model.state_space import StateSpaceModel
from tuning.problems.data import Data
from tuning.problems.find import find_problem

BEGIN = 150  # step at which a fault begins
RUNS = 100
BIASES = (0.5, 1.0, 2.0, 5.0)  # in standard deviations of the measurement noise
DRIFT, NOISE, LOST = 0.05, 2.0, 0.8  # deviations a step; factor on the deviation; factor on the thrust
BETWEEN = 100_000.0  # steps between false alarms
FIRST_SEED = 7_000  # of runs that nothing else here uses
LOST_BLADES = f"thrust factor {LOST:g}"


class Plant(NamedTuple):
    """A filter whose innovations are watched, and the channel that fails."""

    name: str
    problem: str
    channel: int
    weakened: Callable[[StateSpaceModel, np.ndarray], tuple[StateSpaceModel, np.ndarray]]  # truth with lost blades


class Delay(NamedTuple):
    """How soon a fault was found, over all runs."""

    found: float  # share of runs in which it was found before the end
    median: float  # readings from its beginning on, up to the first alarm; inf if less than half found it
    first: str  # the test that was the first most often


def of_thruster(model: StateSpaceModel, inputs: np.ndarray) -> tuple[StateSpaceModel, np.ndarray]:
    """A propeller with less lift."""
    problem = find_problem("nominal")
    return problem.model(**(problem.true or {}), parameter_factors={"lift_coefficient": LOST}), inputs


def of_vehicle(model: StateSpaceModel, inputs: np.ndarray) -> tuple[StateSpaceModel, np.ndarray]:
    """A vehicle whose thrusters give less than they are told."""
    return model, LOST * inputs


PLANTS = (
    Plant("thruster", "nominal", 0, of_thruster),
    Plant("vehicle", "auv:motion", 0, of_vehicle),
)


def biased(size: float, z: np.ndarray, sigma: float, rng: np.random.Generator) -> None:
    """A constant error from one step to the next."""
    z += size * sigma


def drifting(z: np.ndarray, sigma: float, rng: np.random.Generator) -> None:
    """An error that grows."""
    z += DRIFT * sigma * np.arange(1, z.shape[1] + 1)


def stuck(z: np.ndarray, sigma: float, rng: np.random.Generator) -> None:
    """One reading, again and again, whenever there is one."""
    present = ~np.isnan(z)
    z[:] = np.where(present, z[np.arange(len(z)), present.argmax(axis=1)][:, None], np.nan)


def noisy(z: np.ndarray, sigma: float, rng: np.random.Generator) -> None:
    """Noise with another standard deviation."""
    z += math.sqrt(NOISE**2 - 1.0) * sigma * rng.standard_normal(z.shape)


FAULTS: Mapping[str, Callable[[np.ndarray, float, np.random.Generator], None]] = {
    **{f"bias of {size:g} sigma": partial(biased, size) for size in BIASES},
    f"drift of {DRIFT:g} sigma a step": drifting,
    "stuck": stuck,
    "noise doubled": noisy,
}


def delays(plant: Plant, runs: int = RUNS, monitor: Monitor | None = None) -> dict[str, Delay]:
    """Delays of all faults, and as "none" what is raised without one."""
    problem, monitor = find_problem(plant.problem), monitor or Monitor(steps_between=BETWEEN)
    data = problem.data(range(FIRST_SEED, FIRST_SEED + runs))
    model = problem.model(**(problem.true or {}))
    filter_ = make_filter("ekf", model)
    sigma, rng = math.sqrt(model.measurement_noise_cov[plant.channel, plant.channel]), np.random.default_rng(0)
    by_fault = {"none": _delay(filter_, data, data.measurements, plant.channel, monitor)}
    for name, spoil in FAULTS.items():
        z = data.measurements.copy()
        spoil(z[:, BEGIN:, plant.channel], sigma, rng)
        by_fault[name] = _delay(filter_, data, z, plant.channel, monitor)
    by_fault[LOST_BLADES] = _delay(filter_, data, _weakened(plant, model, data), plant.channel, monitor)
    return by_fault


def _weakened(plant: Plant, model: StateSpaceModel, data: Data) -> np.ndarray:
    """Measurements of a plant whose second half goes on from the same states with less thrust."""
    weak, inputs = plant.weakened(model, data.inputs)
    assert data.states is not None  # of a problem with truth
    z = data.measurements.copy()
    for run_index, (states, seed) in enumerate(zip(data.states, data.seeds, strict=True)):
        begun = weak.replace(prior_mean=states[BEGIN], prior_cov=1e-300 * np.eye(model.n))
        simulated = simulate(begun, filter_keys([seed]), inputs[run_index : run_index + 1, BEGIN:]).measurements[0]
        z[run_index, BEGIN:] = np.where(np.isnan(z[run_index, BEGIN:]), np.nan, simulated)
    return z


def _delay(filter_: Filter, data: Data, z: np.ndarray, channel: int, monitor: Monitor) -> Delay:
    estimates = run(filter_, filter_keys(data.seeds), data.inputs, z)
    readings, tests = [], []
    for v, s, measured in zip(estimates.innovations, estimates.innovation_covs, z, strict=True):
        after = [alarm for alarm in monitor.alarms(v, s, measured) if alarm.step >= BEGIN]
        count = np.isfinite(measured[BEGIN : after[0].step + 1, channel]).sum() if after else math.inf
        readings.append(max(float(count), 1.0))
        tests += [after[0].test] if after else []
    most = max(TESTS, key=tests.count) if tests else ""
    return Delay(len(tests) / len(readings), float(np.median(readings)), most)


def best_delay(shift: float, steps: float = BETWEEN) -> float:
    """Mean delay of the one-sided CUSUM for a shift of a normalised innovation: no test has a shorter worst case.

    Source: Moustakides (1986), "Optimal stopping times for detecting changes in distributions".
    """
    k = 0.5 * shift
    return cusum_run_length(cusum_threshold(steps, k, sides=1), k, shift, sides=1)


def shifts(plant: Plant) -> list[float]:
    """What biases are to the innovation, in its standard deviations, before the filter follows them."""
    problem = find_problem(plant.problem)
    model, data = problem.model(**(problem.true or {})), problem.data([FIRST_SEED])
    covs = run(make_filter("ekf", model), filter_keys(data.seeds), data.inputs, data.measurements).innovation_covs
    s = float(np.mean(covs[0, BEGIN:, plant.channel, plant.channel]))
    return [size * math.sqrt(model.measurement_noise_cov[plant.channel, plant.channel] / s) for size in BIASES]


def markdown(runs: int = RUNS) -> str:
    """The table of delays."""
    by_plant = [delays(plant, runs) for plant in PLANTS]
    best = [[f"{best_delay(shift):.1f}" for shift in shifts(plant)] for plant in PLANTS]
    rows = []
    for i, name in enumerate(by_plant[0]):
        cells = [name if name != "none" else "no fault"]
        for of_plant, theory in zip(by_plant, best, strict=True):
            of_bias = theory[i - 1] if 0 < i <= len(BIASES) else ""
            cells += [f"{of_plant[name].median:g}", f"{of_plant[name].found:.0%}", of_plant[name].first, of_bias]
        rows.append([cell.replace("inf", "none") for cell in cells])
    heads = [
        f"{plant.name}: {what}" for plant in PLANTS for what in ("readings", "found", "first test", "best CUSUM")
    ]
    return markdown_table(["fault", *heads], rows)


TABLES = {"delays": markdown}
