"""The effect of a larger process noise after each reversal of the command on the recordings.

NIS is the normalised innovation squared.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from thruster_env.plants.shape import observation_slopes, transition_slopes
from thruster_env.plants.state_space import StateSpaceModel
from thruster_env.studies.recordings.measure import ratios
from thruster_env.studies.recordings.model import DT, on_line
from thruster_env.studies.recordings.runs import Recording

AFTER = 0.4  # s after the start and after each reversal
FACTORS = (1.0, 4.0, 16.0, 64.0, 256.0)  # on Q in that time


class Regime(NamedTuple):
    """Results with a factor on Q after reversals."""

    factor: float
    log_likelihood: float  # of the tachometer, all runs
    nis: float  # mean over all steps; expected value 1
    ratio: float  # mean over the runs of the thrust's error over that of the recorder's own


def regimes(model: StateSpaceModel, runs: Sequence[Recording], factors: Sequence[float] = FACTORS) -> list[Regime]:
    """An extended Kalman filter with each factor on Q after reversals.

    No filter of the project changes Q during a run: this one is plain NumPy. With a factor of 1 it is equal to the
    project's filter, which a test checks.
    """
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
    c, x, p = model.constants, model.prior_mean.copy(), model.prior_cov.copy()
    r, thrust = model.measurement_noise_cov[0, 0], np.empty(len(run.times))
    squares, likelihood, large = [], 0.0, after_reversal(run.command)
    by_motion, by_sight = (make(model.functions, model.shape) for make in (transition_slopes, observation_slopes))
    for k, z in enumerate(run.tachometer):
        if k:
            u = (run.command[k - 1],)
            for _ in range(model.substeps):
                f = np.array(by_motion(tuple(x), model.scales, u, c))
                x, p = np.array(model.transition(tuple(x), u, c)), f @ p @ f.T
            p = p + model.process_noise_cov * (factor if large[k - 1] else 1.0)
        if not np.isnan(z):
            h = np.array(by_sight(tuple(x), model.scales, c))[0]
            s, v = h @ p @ h + r, z - model.observe(tuple(x), c)[0]
            gain = p @ h / s
            x, p = x + gain * v, p - np.outer(gain, gain) * s
            squares.append(v * v / s)
            likelihood -= 0.5 * (v * v / s + np.log(2 * np.pi * s))
        thrust[k] = model.outputs["T"].function(tuple(x), c)
    return thrust, np.array(squares), likelihood
