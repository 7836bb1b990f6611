"""Runs of the thruster for docs/filters.md and filters' errors on them, with fixed seeds."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from filters import Estimates, run
from filters.consistency.nees import normalized_squares
from filters.filter import Filter
from filters.logs.figure import TRUTH, plot_style
from filters.registry import FILTERS
from thruster_env.core.plots import MUSTARD
from thruster_env.core.streams import episode_keys, filter_keys
from thruster_env.thruster.engine.copies import simulate
from thruster_env.thruster.plant import Plant, make_plant
from tuning.problems.data import FIRST_SCORED_STEP
from tuning.problems.excitation import held_levels

SEED, RUNS, STEPS, AMPLITUDE, HOLD, DT = 1, 60, 500, 12.0, 25, 0.01
PUBLISHED_NOISE = {"process_noise_cov": (0.5, 0.5), "measurement_noise_cov": 0.5}

# Those of the page alone beside those that filters have everywhere.
STYLES = {name: plot_style(name) for name in FILTERS} | {
    "truth": TRUTH,
    "scheduled": {"color": MUSTARD, "linestyle": "-."},
}


class Runs(NamedTuple):
    """Keys, inputs and measurements of B runs of K steps, and the true states."""

    keys: np.ndarray  # (B, 2), the filters'
    inputs: np.ndarray  # (B, K, 1) [V]
    measurements: np.ndarray  # (B, K + 1, m), NaN where missing
    states: np.ndarray  # (B, K + 1, 2)

    @property
    def arguments(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The arguments of `filters.run`."""
        return self.keys, self.inputs, self.measurements


def runs_of(plant: Plant, voltages: np.ndarray) -> Runs:
    """Runs of a plant under voltages (B, K), with the seeds 0, 1, ..."""
    seeds = range(len(voltages))
    simulated = simulate(plant, episode_keys(seeds), voltages)
    measurements = np.where(simulated.valid, simulated.measurements, np.nan)
    return Runs(filter_keys(seeds), voltages[..., None], measurements, simulated.states)


def held_runs(runs: int = RUNS, amplitude: float = AMPLITUDE, centre: float = 0.0, **plant) -> Runs:
    """Runs of `make_plant(**plant)` under levels about a centre [V], each held for a quarter of a second."""
    levels = held_levels(episode_keys(range(runs)), amplitude, HOLD, STEPS)
    return runs_of(make_plant(**plant), centre + levels)


def rmse(estimates: Estimates, runs: Runs) -> np.ndarray:
    """RMSE of (omega_m [rad/s], U_a [m/s]) from step 50 on, over all runs."""
    errors = estimates.means[..., :2] - runs.states
    return np.sqrt((errors[:, FIRST_SCORED_STEP:] ** 2).mean(axis=(0, 1)))


def nees(estimates: Estimates, runs: Runs) -> float:
    """Mean NEES of (omega_m, U_a) from step 50 on; 2 is right. NaN without a covariance."""
    errors = (estimates.means[..., :2] - runs.states)[:, FIRST_SCORED_STEP:]
    squares = normalized_squares(errors, estimates.covs[:, FIRST_SCORED_STEP:, :2, :2])
    regular = squares[~np.isnan(squares)]  # singular covariances are left out
    return float(regular.mean()) if regular.size else float("nan")


def errors_of(filter_: Filter, runs: Runs) -> tuple[float, float, float]:
    """RMSE of omega_m [rad/s], RMSE of U_a [m/s] and mean NEES of a filter."""
    estimates = run(filter_, *runs.arguments)
    return (*rmse(estimates, runs), nees(estimates, runs))


def deviations(estimates: Estimates, state: int) -> np.ndarray:
    """Standard deviations (B, K + 1) that a filter claims for a state."""
    return np.sqrt(estimates.covs[..., state, state])


def times(count: int) -> np.ndarray:
    """Times [s] of so many steps, from 0 on."""
    return DT * np.arange(count)
