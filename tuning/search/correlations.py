"""A full covariance matrix from variances and correlations, which may be chosen independently of one another."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

ROUNDING = 1e-12  # of correlations: what is below is nothing


def full_covariance(variances: Sequence[float], correlations: Sequence[float]) -> np.ndarray:
    """A covariance (n, n), positive semidefinite by construction: S L L' S, S the standard deviations.

    L is the Cholesky factor of the correlations, by rows: with r_ij the correlation of states i and j once the
    states before j are known, L_ij = r_ij sqrt(1 - sum_{k<j} L_ik^2) for j < i, and L_ii the root that remains.

    Args:
        variances: n positive numbers.
        correlations: r_21, r_31, r_32, ..., n (n - 1) / 2 numbers from -1 to 1. For two states the one is the
            correlation itself.

    Raises:
        ValueError: if a variance is not positive, a correlation is not from -1 to 1, or there are too few.

    Source: Lewandowski, Kurowicka, Joe (2009), "Generating random correlation matrices based on vines and extended
    onion method", J. Multivariate Analysis 100(9).
    """
    diagonal, count = np.asarray(variances, dtype=np.float64), len(variances) * (len(variances) - 1) // 2
    if not (diagonal > 0).all():
        raise ValueError(f"variances must be positive, but got {diagonal.tolist()}")
    if len(correlations) != count or not all(abs(r) <= 1 for r in correlations):
        raise ValueError(f"correlations must be {count} numbers from -1 to 1, but got {list(correlations)}")
    factor = np.sqrt(diagonal)[:, None] * _lower(len(diagonal), correlations)
    return factor @ factor.T


def correlation_slopes(variances: Sequence[float], correlations: Sequence[float]) -> np.ndarray:
    """Derivatives of `full_covariance` by its correlations, (n (n - 1) / 2, n, n).

    Only row i of L depends on r_ij: L_ij grows with sqrt(1 - sum_{k<j} L_ik^2), and later entries shrink
    with r_ij / (1 - r_ij^2).
    """
    n = len(variances)
    lower, deviations = _lower(n, correlations), np.sqrt(np.asarray(variances, dtype=np.float64))
    slopes, given, k = np.zeros((len(correlations), n, n)), list(correlations), 0
    for i in range(n):
        for j in range(i):
            by = np.zeros(n)
            by[j] = np.sqrt(max(1.0 - float(lower[i, :j] @ lower[i, :j]), 0.0))
            by[j + 1 :] = -given[k] / (1.0 - given[k] ** 2) * lower[i, j + 1 :]
            row = deviations[i] * deviations * (lower @ by)
            row[i] = 0.0  # the variance stays
            slopes[k, i], slopes[k, :, i] = row, row
            k += 1
    return slopes


def _lower(n: int, correlations: Sequence[float]) -> np.ndarray:
    """The Cholesky factor L of the correlations."""
    lower, given = np.zeros((n, n)), iter(correlations)
    for i, row in enumerate(lower):
        for j in range(i):
            row[j] = next(given) * np.sqrt(max(1.0 - float(row[:j] @ row[:j]), 0.0))
        row[i] = np.sqrt(max(1.0 - float(row[:i] @ row[:i]), 0.0))
    return lower


def correlations_of(cov: np.ndarray) -> list[float]:
    """The correlations from which `full_covariance` makes a covariance (n, n), which may be singular.

    An undetermined correlation is 0: that of a state with no variance, or with one determined by other states.
    """
    deviations = np.sqrt(np.diag(cov))
    scale = np.where(deviations > 0, deviations, 1.0)
    wanted = np.asarray(cov) / np.outer(scale, scale)
    lower, found = np.zeros(wanted.shape), []
    for i, row in enumerate(lower):
        for j in range(i):
            rest, pivot = np.sqrt(max(1.0 - row[:j] @ row[:j], 0.0)), lower[j, j]
            partial = wanted[i, j] - row[:j] @ lower[j, :j]
            row[j] = np.clip(partial / pivot, -rest, rest) if pivot > 0 and rest > ROUNDING else 0.0
            found.append(float(row[j] / rest) if rest > ROUNDING else 0.0)
        left = wanted[i, i] - row[:i] @ row[:i]
        row[i] = np.sqrt(left) if left > ROUNDING else 0.0
    return found
