"""Scores of probabilistic estimates: coverage, CRPS (continuous ranked probability score) and ranks."""

from __future__ import annotations

import numpy as np
from scipy.special import ndtr, ndtri

LEVELS = np.arange(0.05, 1.0, 0.05)  # of intervals whose coverage is looked at


def covered(errors: np.ndarray, deviations: np.ndarray, level: float = 0.95) -> np.ndarray:
    """1 where an error lies in its Gaussian interval of a level, else 0; NaN without a positive deviation."""
    reach = ndtri(0.5 + 0.5 * level)
    return np.where((deviations > 0) & ~np.isnan(errors), np.abs(errors) <= reach * deviations, np.nan)


def gaussian_crps(errors: np.ndarray, deviations: np.ndarray) -> np.ndarray:
    """Continuous ranked probability score of N(mean, deviation^2), from errors mean - truth of the same shape.

        s (z (2 Phi(z) - 1) + 2 phi(z) - 1/sqrt(pi)),  z = e/s;  |e| for s = 0

    It has the unit of the state, is smallest on average for the true distribution, and equals the absolute error
    if the standard deviation is zero. If the forecast distribution is correct, its mean is s/sqrt(pi).

    Source: Gneiting, Raftery (2007), "Strictly proper scoring rules, prediction, and estimation", section 4.2.
    """
    positive = np.where(deviations > 0, deviations, 1.0)
    z = errors / positive
    density = np.exp(-0.5 * z * z) / np.sqrt(2.0 * np.pi)
    score = positive * (z * (2.0 * ndtr(z) - 1.0) + 2.0 * density - 1.0 / np.sqrt(np.pi))
    return np.where(deviations > 0, score, np.abs(errors))


def expected_gaussian_crps(deviations: np.ndarray) -> np.ndarray:
    """Mean CRPS of a Gaussian forecast if it is right: s/sqrt(pi)."""
    return deviations / np.sqrt(np.pi)


def ensemble_crps(
    truth: np.ndarray, members: np.ndarray, weights: np.ndarray | None = None, *, fair: bool = False
) -> np.ndarray:
    """Continuous ranked probability score of ensembles.

        sum_j w_j |x_j - y| - 1/2 sum_ij w_i w_j |x_i - x_j|

    Args:
        truth: y, (...,).
        members: x, (..., N).
        weights: w, (..., N) with sum 1; equal if None.
        fair: divide the second sum of an unweighted ensemble by N (N - 1) in place of N^2, which makes the mean
            score what an infinite ensemble of the same distribution would have.

    Raises:
        ValueError: if fair is asked of weighted members.

    Source: Gneiting, Raftery (2007), equation (21); fair: Ferro (2014), "Fair scores for ensemble forecasts".
    """
    if fair and weights is not None:
        raise ValueError("a fair score needs members without weights, but got weights")
    size = members.shape[-1]
    order = np.argsort(members, axis=-1)
    x = np.take_along_axis(members, order, axis=-1)
    w = np.full(x.shape, 1.0 / size) if weights is None else np.take_along_axis(weights, order, axis=-1)
    # In ascending order sum_ij w_i w_j |x_i - x_j| / 2 is a sum over gaps: weight below times weight above.
    below = w.cumsum(axis=-1)[..., :-1]
    spread = (below * (1.0 - below) * np.diff(x, axis=-1)).sum(axis=-1)
    if fair:
        spread = spread * size / (size - 1.0)
    return (w * np.abs(x - truth[..., None])).sum(axis=-1) - spread


def ensemble_ranks(truth: np.ndarray, members: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
    """Where the truth (...,) stands among members (..., N), as (rank + 1/2)/(N + 1) in 0 ... 1.

    The rank is the number of members below the truth, 0 ... N; with weights (..., N) it is N times their weight.
    NaN where there is no truth.
    For a consistent ensemble all ranks are equally likely. Source: Hamill (2001), "Interpretation of rank
    histograms for verifying ensemble forecasts".
    """
    size = members.shape[-1]
    below = members < truth[..., None]
    rank = below.sum(axis=-1) if weights is None else size * (weights * below).sum(axis=-1)
    return np.where(np.isnan(truth), np.nan, (rank + 0.5) / (size + 1.0))
