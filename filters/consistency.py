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
    scale = np.sqrt(np.einsum("...ii->...i", covs))
    with np.errstate(divide="ignore", invalid="ignore"):
        unit = covs / (scale[..., :, None] * scale[..., None, :])
    regular = np.isfinite(unit).all(axis=(-1, -2))
    unit = np.where(regular[..., None, None], unit, np.eye(d))
    regular &= np.linalg.eigvalsh(unit)[..., 0] > 1e-12
    unit = np.where(regular[..., None, None], unit, np.eye(d))
    scaled = np.divide(errors, scale, out=np.zeros_like(errors), where=regular[..., None])
    solved = np.linalg.solve(unit, scaled[..., None])[..., 0]
    return np.where(regular, np.einsum("...i,...i->...", scaled, solved), np.nan)
