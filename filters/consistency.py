"""Is a filter's covariance honest? NEES, NIS and their means."""

from __future__ import annotations

import numpy as np


def normalized_squares(errors: np.ndarray, covs: np.ndarray) -> np.ndarray:
    """E' P^-1 e for errors (..., d) and covariances (..., d, d); NaN where P is singular.

    With estimation errors this is the NEES, with innovations and their covariances the NIS; for an honest
    filter each is chi-squared with d degrees of freedom. Source: Bar-Shalom, Li, Kirubarajan (2001),
    Estimation with Applications to Tracking and Navigation, section 5.4.
    """
    d = errors.shape[-1]
    root, solved = {}, []
    total, regular = np.zeros(errors.shape[:-1]), np.ones(errors.shape[:-1], dtype=bool)
    for i in range(d):  # Cholesky factor and forward substitution, each entry an array over all covariances
        for j in range(i):
            rest = sum(root[i, k] * root[j, k] for k in range(j))
            root[i, j] = (covs[..., i, j] - rest) / root[j, j]
        pivot = covs[..., i, i] - sum(root[i, k] ** 2 for k in range(i))
        regular &= pivot > 1e-12 * covs[..., i, i]
        root[i, i] = np.sqrt(np.where(regular, pivot, 1.0))
        solved.append((errors[..., i] - sum(root[i, k] * solved[k] for k in range(i))) / root[i, i])
        total += solved[i] ** 2
    return np.where(regular, total, np.nan)
