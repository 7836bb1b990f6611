"""Whole trajectories of a plant's copies, without an env around them."""

from __future__ import annotations

import numpy as np

from plants.copies import PlantCopies


def recorded(copies: PlantCopies, keys: np.ndarray, inputs: np.ndarray) -> np.ndarray:
    """Reports (B, K + 1, reported) of B copies that run from their initial state under inputs (B, K, p).

    The same keys (B, 2) and inputs give the same numbers as an env that is stepped through Gymnasium.

    Raises:
        ValueError: if shapes do not fit, or an input is NaN.
    """
    keys, inputs = (np.ascontiguousarray(a, dtype=np.float64) for a in (keys, inputs))
    if keys.ndim != 2 or keys.shape[1] != 2 or not np.isfinite(keys).all():
        raise ValueError(f"keys must be finite and of shape (B, 2), but got shape {keys.shape}")
    p = len(copies.commands)
    if inputs.ndim != 3 or len(inputs) != len(keys) or inputs.shape[2] != p or np.isnan(inputs).any():
        rule = f"without NaN and of shape ({len(keys)}, K, {p}), one sequence a key"
        raise ValueError(f"inputs must be {rule}, but got shape {inputs.shape}")
    record = np.empty((inputs.shape[1] + 1, copies.reported, len(keys)))
    record[0] = copies.begin(keys)
    for k in range(inputs.shape[1]):
        record[k + 1] = copies.step(inputs[:, k])
    return np.ascontiguousarray(record.transpose(2, 0, 1))


def check_finite(what: str, *parts: np.ndarray) -> None:
    """Raise ValueError that names the first step at which a number of the parts (B, K + 1, ...) is not finite."""
    finite = np.all([np.isfinite(part).all(axis=(0, 2)) for part in parts], axis=0)
    if not finite.all():
        raise ValueError(
            f"{what} must stay finite, but it is not from step {np.argmin(finite)} of {len(finite) - 1} on: "
            "mind dt and the noise covariances"
        )
