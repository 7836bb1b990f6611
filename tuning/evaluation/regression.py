"""A filter beside a linear regression of the measurements, which assumes no model: does the model fit the logs?"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from filters.consistency.intervals import Interval, mean_interval
from thruster_env.core.angles import is_angle
from thruster_env.model.state_space import StateSpaceModel
from tuning.evaluation.evaluate import NOTHING, Evaluation
from tuning.problems.data import Data

ORDERS = (1, 2, 3, 5, 8)  # numbers of past rows, among which the training runs choose
MOST_NUMBERS = 1_000_000  # of the matrix of regressors
LEAST_VARIANCE = 1e-12  # of the residuals, over that of the channel: what is below is rounding
FEWEST = 10  # rows for each weight
FAR = 0.1  # log-likelihood of a measurement by which a filter is far below: its innovations are 10 % larger


def gain_over_regression(model: StateSpaceModel, tuned: Evaluation, training: Data, data: Data) -> Interval:
    """Log-likelihood of a measurement that a filter predicts, minus that of a regression, with paired interval.

    Args:
        model: with the channels; angles are unwrapped.
        tuned: the filter on `data`.
        training: runs that the regression is fitted to.
        data: runs on which both are compared.

    Returns:
        The mean over all scored measurements; NaN for a filter without a covariance, or if there are too few rows.
    """
    angles = [is_angle(i, model.shape.measurement_angles) for i in range(model.m)]
    densities = log_densities(training, data, np.array(angles))
    scored = np.where(data.scored[..., None], densities, np.nan)
    counts = np.isfinite(scored).sum(axis=(1, 2))
    if not counts.all() or np.isnan(tuned.log_likelihoods).any():
        return NOTHING
    return mean_interval((tuned.log_likelihoods - np.nansum(scored, axis=(1, 2))) / counts.mean())


def is_far_below(gained: Interval) -> bool:
    """Whether a filter predicts far worse than the regression: significantly, and by more than `FAR`."""
    return bool(gained.high < 0.0 and gained.value < -FAR)


def log_densities(training: Data, data: Data, angles: np.ndarray) -> np.ndarray:
    """Log density of each measurement given all before it, by least squares for each channel, (B, K + 1, m).

        z_k,i = a + sum over l = 1..p of (b_l z_{k-l} + c_l u_{k-l}) + sum over j < i of d_j z_k,j + e
        e ~ N(0, s^2)

    A channel that is not measured has its last value. The least BIC on the training runs chooses p. Where a run
    has no p rows yet, the density is that of the training runs' mean and variance. NaN where nothing is measured;
    everywhere if the training runs have too few rows.

    Args:
        training: runs for the fit.
        data: runs whose densities are returned.
        angles: (m,) bool, which channels are angles.
    """
    observed, m = training.seen, training.measurements.shape[-1]
    (z_mean, z_std), (u_mean, u_std) = map(_mean_and_std, (observed.measurements, observed.inputs))

    def rows_of(runs: Data) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        z, u = _continued(runs.seen.measurements, angles), runs.seen.inputs
        z, u = (z - z_mean) / z_std, (u - u_mean) / u_std
        return [
            (_past(z_run, u_run), z_run, ~np.isnan(measured))
            for z_run, u_run, measured in zip(z, u, runs.seen.measurements, strict=True)
        ]

    known, rows, densities = rows_of(training), rows_of(data), np.full(data.measurements.shape, np.nan)
    for i in range(m):
        regression = _fitted(known, i)
        if regression is None:
            return np.full(densities.shape, np.nan)
        columns, weights, variance = regression
        for b, (past, z, measured) in enumerate(rows):
            expected = np.hstack([past, z[:, :i]])[:, columns] @ weights
            begun = np.isfinite(expected)
            squares = np.where(begun, (z[:, i] - expected) ** 2 / variance, z[:, i] ** 2)
            logarithm = math.log(2.0 * math.pi * z_std[i] ** 2) + np.where(begun, math.log(variance), 0.0)
            densities[b, :, i] = np.where(measured[:, i], -0.5 * (logarithm + squares), np.nan)
    return densities


def _mean_and_std(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation of each column of values (B, T, n); 0 and 1 where there is neither."""
    known = np.isfinite(values)
    counts = np.maximum(known.sum(axis=(0, 1)), 1)
    mean = np.where(known, values, 0.0).sum(axis=(0, 1)) / counts
    std = np.sqrt((np.where(known, values - mean, 0.0) ** 2).sum(axis=(0, 1)) / counts)
    return mean, np.where(std > 0.0, std, 1.0)


def _continued(z: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Measurements (B, T, m), the last value where one is missing, NaN before the first; angles without jumps."""
    times = np.where(np.isnan(z), -1, np.arange(z.shape[1])[:, None])
    last = np.maximum.accumulate(times, axis=1)
    continued = np.where(last < 0, np.nan, np.take_along_axis(z, np.maximum(last, 0), axis=1))
    for i in np.flatnonzero(angles):
        continued[..., i] = np.where(last[..., i] < 0, np.nan, np.unwrap(np.nan_to_num(continued[..., i]), axis=1))
    return continued


def _past(z: np.ndarray, u: np.ndarray) -> np.ndarray:
    """1, then z and u of the last rows, (T, 1 + 8 (m + p)), from z (T, m) and u (T - 1, p); NaN before these."""
    lagged = np.full((len(z), ORDERS[-1], z.shape[1] + u.shape[1]), np.nan)
    for lag in range(1, ORDERS[-1] + 1):
        lagged[lag:, lag - 1] = np.hstack([z[:-lag], u[: max(len(u) + 1 - lag, 0)]])
    return np.hstack([np.ones((len(z), 1)), lagged.reshape(len(z), -1)])


def _fitted(runs: list, i: int) -> tuple[list[int], np.ndarray, float] | None:
    """Columns, weights and residual variance of the regression of channel i; None if there are too few rows."""
    parts, count = [], 0
    for past, z, measured in runs:
        rows = np.hstack([past, z[:, : i + 1]])
        parts.append(rows[np.isfinite(rows).all(axis=1) & measured[:, i]])
        count += parts[-1].size
        if count > MOST_NUMBERS:
            break
    rows = np.concatenate(parts)
    width, best = (rows.shape[1] - 2 - i) // ORDERS[-1], None
    if len(rows) == 0:
        return None
    # Sums of squares of all these regressions are those of the triangle's columns.
    triangle: Any = np.linalg.qr(rows, mode="r")
    for order in ORDERS:
        columns = [*range(1 + order * width), *range(rows.shape[1] - 1 - i, rows.shape[1] - 1)]
        if len(rows) < FEWEST * len(columns):
            break
        weights = np.linalg.lstsq(triangle[:, columns], triangle[:, -1], rcond=1e-10)[0]
        squares = ((triangle[:, columns] @ weights - triangle[:, -1]) ** 2).sum()
        variance = max(squares / (len(rows) - len(columns)), LEAST_VARIANCE)
        bic = len(rows) * math.log(variance) + len(columns) * math.log(len(rows))
        if best is None or bic < best[0]:
            best = bic, columns, weights, float(variance)
    return None if best is None else best[1:]
