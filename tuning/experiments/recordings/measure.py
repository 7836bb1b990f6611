"""Errors of thrust estimates against the load cell, and their ratios to the recorder's own.

NIS is the normalised innovation squared.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from filters.engine.batch import run as run_filter
from filters.gaussian.extended import ExtendedKalmanFilter
from thruster_env.model.state_space import StateSpaceModel
from tuning.experiments.recordings.identification import CHOSEN, STRUCTURES, Task, thrusts
from tuning.experiments.recordings.model import DT, model, on_line
from tuning.experiments.recordings.runs import Recording

WINDOW = 5  # rows, 0.2 s, over which estimate and load cell are averaged: the mount swings at 14 Hz
SHIFTS = np.arange(-0.12, 0.1201, 0.01)  # of the clock [s]; each estimate may have its best one
SETTLED = 1.2  # after the start, and after every change of the command's sign [s]


class Ratios(NamedTuple):
    """RMSE of an estimate over that of the recorder's own, on one run."""

    averaged: float  # over windows, at the run's clock offset
    best_shift: float  # the same, where each has its own best offset
    raw: float  # of single rows


def averaged(values: np.ndarray, window: int = WINDOW) -> np.ndarray:
    """Centred means over `window` rows, fewer at the ends."""
    ones = np.ones(window)
    return np.convolve(values, ones, "same") / np.convolve(np.ones(len(values)), ones, "same")


def error(estimate: np.ndarray, run: Recording, offset: float, window: int = WINDOW) -> np.ndarray:
    """Estimate minus load cell [N], on the rows of the load cell.

    Args:
        estimate: (K + 1,), on the recorder's clock.
        run: with the load cell.
        offset: how far the load cell's clock is ahead [s].
        window: rows to average over.
    """
    shifted = np.interp(run.times - offset, run.times, estimate)
    return averaged(shifted, window) - averaged(run.load, window)


def rmse(estimate: np.ndarray, run: Recording, offset: float | None = None, window: int = WINDOW) -> float:
    """Root mean square of `error`, at the run's clock offset unless another one is given."""
    errors = error(estimate, run, run.offset if offset is None else offset, window)
    return float(np.sqrt((errors**2).mean()))


def settled_rmse(estimate: np.ndarray, run: Recording, window: int = WINDOW) -> float:
    """`rmse` over the rows later than 1.2 s after the start and after every change of the command's sign."""
    signs = np.sign(run.command)
    changes = [run.times[0], *run.times[1:][(signs[1:] != signs[:-1]) & (signs[1:] != 0)]]
    quiet = np.all([(run.times < when) | (run.times > when + SETTLED) for when in changes], axis=0)
    return float(np.sqrt((error(estimate, run, run.offset, window)[quiet] ** 2).mean()))


def best_rmse(estimate: np.ndarray, run: Recording) -> float:
    """`rmse` at the clock offset at which it is least."""
    return min(rmse(estimate, run, shift) for shift in SHIFTS)


def ratios(estimate: np.ndarray, run: Recording) -> Ratios:
    """An estimate's errors over those of the recorder's own."""
    return Ratios(
        rmse(estimate, run) / rmse(run.own, run),
        best_rmse(estimate, run) / best_rmse(run.own, run),
        rmse(estimate, run, window=1) / rmse(run.own, run, window=1),
    )


# Estimates of thrust on the recorded runs: ours, the recorder's own, and trivial ones.


OURS, OWN, DESIRED, STATIC, LOOKUP = "ours", "recorder's", "desired", "static map", "lookup"
# Least squares on the table of steady states of the same source, ahead and astern.
STATIC_FACTORS = 0.968e-3, 0.979e-3  # T = c n|n| [N s^2]
LOOKUP_FACTORS, LOOKUP_BAND = (2.51, 2.62), 0.84  # T = k (|u| - 0.84)^2 [N/V^2, V]


def estimates_of(runs: Sequence[Recording], held_out: Mapping[str, Mapping] | None = None) -> dict[str, list]:
    """Thrust (K + 1,) on each run by every estimator, by name.

    Args:
        runs: recorded.
        held_out: tasks by name (`results.identify_all`): our estimate of a run then has the parameters that were
            identified without this run. If None those of `identified.toml`.
    """
    ours = thrusts(model(), runs) if held_out is None else left_out(CHOSEN, runs, held_out)
    return {
        OURS: ours,
        OWN: [run.own for run in runs],
        DESIRED: [run.desired for run in runs],
        STATIC: [_static(run) for run in runs],
        LOOKUP: [_lookup(run) for run in runs],
    }


def left_out(structure: str, runs: Sequence[Recording], tasks: Mapping[str, Mapping]) -> list[np.ndarray]:
    """Thrust on each run by a structure that was identified without that run."""
    chosen, estimates = STRUCTURES[structure], []
    for run in runs:
        values = tasks[Task(structure, run.name).name]["values"]
        estimates += thrusts(chosen.model(**values), [run], chosen.ambient)
    return estimates


def structure_ratios(structure: str, runs: Sequence[Recording], tasks: Mapping[str, Mapping]) -> list[Ratios]:
    """Ratios to the recorder's own estimate on each run, left out of the identification."""
    return [ratios(estimate, run) for estimate, run in zip(left_out(structure, runs, tasks), runs, strict=True)]


def _static(run: Recording) -> np.ndarray:
    """From the tachometer with the sign of the previous command."""
    sign = np.sign(np.append(0.0, run.command[:-1]))
    speed = sign * np.nan_to_num(run.tachometer)
    return np.where(speed > 0, *STATIC_FACTORS) * speed * abs(speed)


def _lookup(run: Recording) -> np.ndarray:
    """From the previous command."""
    command = np.append(0.0, run.command[:-1])
    beyond = np.maximum(abs(command) - LOOKUP_BAND, 0.0)
    return np.sign(command) * np.where(command > 0, *LOOKUP_FACTORS) * beyond**2


# The effect of a larger process noise after each reversal of the command on the recordings.


AFTER = 0.4  # s after the start and after each reversal
FACTORS = (1.0, 4.0, 16.0, 64.0, 256.0)  # on Q in that time


class Regime(NamedTuple):
    """Results with a factor on Q after reversals."""

    factor: float
    log_likelihood: float  # of the tachometer, all runs
    nis: float  # mean over all steps; expected value 1
    ratio: float  # mean over the runs of the thrust's error over that of the recorder's own


def regimes(model: StateSpaceModel, runs: Sequence[Recording], factors: Sequence[float] = FACTORS) -> list[Regime]:
    """The extended Kalman filter with each factor on Q after reversals."""
    tachometer_model, results = on_line(model), []
    for factor in factors:
        parts = [_filtered(tachometer_model, run, factor) for run in runs]
        squares = np.concatenate([part[1] for part in parts])
        values = [ratios(part[0], run).averaged for part, run in zip(parts, runs, strict=True)]
        likelihood = sum(part[2] for part in parts)
        results.append(Regime(factor, likelihood, float(squares.mean()), float(np.mean(values))))
    return results


def after_reversal(command: np.ndarray) -> np.ndarray:
    """Whether each step lies within 0.4 s of the start, or of a change of the command's sign."""
    signs = np.sign(command)
    changed = np.append(True, (signs[1:] != signs[:-1]) & (signs[1:] != 0))
    return np.convolve(changed, np.ones(round(AFTER / DT)))[: len(command)] > 0


def _filtered(model: StateSpaceModel, run: Recording, factor: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Thrust (K + 1,), NIS of the steps that were measured, and their log-likelihood."""
    factors = np.where(after_reversal(run.command)[:-1], factor, 1.0)
    estimates = run_filter(
        ExtendedKalmanFilter(model=model),
        inputs=run.command[None, :-1, None],
        measurements=run.tachometer[None, :, None],
        process_noise_covs=factors[:, None, None] * model.process_noise_cov,
    )
    thrust = [model.outputs["T"].function(tuple(mean), model.constants) for mean in estimates.means[0]]
    measured = ~np.isnan(run.tachometer)
    squares = estimates.innovations[0, measured, 0] ** 2 / estimates.innovation_covs[0, measured, 0, 0]
    return np.array(thrust), squares, float(estimates.log_likelihoods.sum())
