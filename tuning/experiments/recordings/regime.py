"""The effect of a larger process noise after each reversal of the command on the recordings.

NIS is the normalised innovation squared.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from filters.engine.batch import run as run_filter
from filters.gaussian.extended import ExtendedKalmanFilter
from thruster_env.model.state_space import StateSpaceModel
from tuning.experiments.recordings.measure import ratios
from tuning.experiments.recordings.model import DT, on_line
from tuning.experiments.recordings.runs import Recording

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
    seen, found = on_line(model), []
    for factor in factors:
        parts = [_filtered(seen, run, factor) for run in runs]
        squares = np.concatenate([part[1] for part in parts])
        values = [ratios(part[0], run).averaged for part, run in zip(parts, runs, strict=True)]
        likelihood = sum(part[2] for part in parts)
        found.append(Regime(factor, likelihood, float(squares.mean()), float(np.mean(values))))
    return found


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
