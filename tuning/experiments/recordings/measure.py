"""Errors of thrust estimates against the load cell, and their ratios to the recorder's own."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

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
    found = error(estimate, run, run.offset if offset is None else offset, window)
    return float(np.sqrt((found**2).mean()))


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
