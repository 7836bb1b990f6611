"""A full covariance matrix from variances and correlations, which may be chosen independently of one another."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def full_covariance(variances: Sequence[float], correlations: Sequence[float]) -> np.ndarray:
    """A covariance (n, n) that is positive definite by construction: S L L' S, S the standard deviations.

    L is the Cholesky factor of the correlations, by rows: with r_ij the correlation of states i and j once the
    states before j are known, L_ij = r_ij sqrt(1 - sum_{k<j} L_ik^2) for j < i, and L_ii the root that remains.

    Args:
        variances: n positive numbers.
        correlations: r_21, r_31, r_32, ..., n (n - 1) / 2 numbers within -1 and 1. For two states the one is the
            correlation itself.

    Raises:
        ValueError: if a variance is not positive, a correlation is not within -1 and 1, or there are too few.

    Source: Lewandowski, Kurowicka, Joe (2009), "Generating random correlation matrices based on vines and extended
    onion method", J. Multivariate Analysis 100(9).
    """
    diagonal, count = np.asarray(variances, dtype=np.float64), len(variances) * (len(variances) - 1) // 2
    if not (diagonal > 0).all():
        raise ValueError(f"variances must be positive, but got {diagonal.tolist()}")
    if len(correlations) != count or not all(abs(r) < 1 for r in correlations):
        raise ValueError(f"correlations must be {count} numbers within -1 and 1, but got {list(correlations)}")
    lower, given = np.zeros((len(diagonal),) * 2), iter(correlations)
    for i, row in enumerate(lower):
        for j in range(i):
            row[j] = next(given) * np.sqrt(1.0 - row[:j] @ row[:j])
        row[i] = np.sqrt(1.0 - row[:i] @ row[:i])
    factor = np.sqrt(diagonal)[:, None] * lower
    return factor @ factor.T


def correlations_of(cov: np.ndarray) -> list[float]:
    """The correlations from which `full_covariance` makes a positive definite covariance (n, n)."""
    deviations = np.sqrt(np.diag(cov))
    lower = np.linalg.cholesky(np.asarray(cov) / np.outer(deviations, deviations))
    return [float(row[j] / np.sqrt(1.0 - row[:j] @ row[:j])) for i, row in enumerate(lower) for j in range(i)]
