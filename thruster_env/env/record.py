"""Trajectories of many copies of a plant: the reports of a batch stepped through given inputs."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from thruster_env.core.checks import as_floats
from thruster_env.env.copies import PlantCopies


def record(
    copies_of: Callable[[int], PlantCopies], keys: np.ndarray, inputs: np.ndarray, name: str, count: int
) -> np.ndarray:
    """Reports (B, K + 1, reported) of a batch of B copies from their start on.

    Args:
        copies_of: `copies_of(count)` makes that many copies.
        keys: of their episodes, (B, 2).
        inputs: (B, K, p), or (B, K) if p is 1.
        name: the name of the inputs, for messages.
        count: their number p.

    Raises:
        ValueError: if shapes do not fit or a number is not finite.
    """
    keys, inputs = (np.ascontiguousarray(as_floats(a)) for a in (keys, inputs))
    if keys.ndim != 2 or keys.shape[1] != 2 or not np.isfinite(keys).all():
        raise ValueError(f"keys must be finite and of shape (B, 2), but got shape {keys.shape}")
    rest = () if count == 1 else (count,)
    fits = inputs.ndim == 2 + len(rest) and len(inputs) == len(keys) and inputs.shape[2:] == rest
    if not fits or np.isnan(inputs).any():
        shape = f"({len(keys)}, K{''.join(f', {size}' for size in rest)})"
        rule = f"{name} must be without NaN and of shape {shape}, one row per key"
        raise ValueError(f"{rule}, but got shape {inputs.shape}")
    copies = copies_of(len(keys))
    reports = np.empty((inputs.shape[1] + 1, copies.reported, len(keys)))
    reports[0] = copies.begin(keys)
    for k in range(inputs.shape[1]):
        reports[k + 1] = copies.step(inputs[:, k])
    return np.ascontiguousarray(reports.transpose(2, 0, 1))


def check_finite(what: str, *parts: np.ndarray) -> None:
    """Raise ValueError that names the first step at which a number of the parts (B, K + 1, ...) is not finite."""
    finite = np.all([np.isfinite(part).all(axis=(0, 2)) for part in parts], axis=0)
    if not finite.all():
        raise ValueError(
            f"{what} must stay finite, but it is not from step {np.argmin(finite)} of {len(finite) - 1} on: "
            "check dt and the noise covariances"
        )
