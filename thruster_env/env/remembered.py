"""A policy's memory between two steps of its env."""

from __future__ import annotations

import numpy as np


def remembered(state, episode_start, at_start: np.ndarray) -> np.ndarray:
    """The state (..., k) of the last call, or its initial value at the start of an episode."""
    if state is None:
        return at_start
    if episode_start is None:
        return np.asarray(state)
    starts = np.reshape(episode_start, at_start.shape[:-1]).astype(bool)
    return np.where(starts[..., None], at_start, state)
