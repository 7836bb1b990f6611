"""What an estimate is off by: the one place where errors are formed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def state_errors(means: np.ndarray, states: np.ndarray, angles: Sequence[bool] = ()) -> np.ndarray:
    """Estimates less truth, (..., n), angles the short way round: e = mean - x, in (-pi, pi] for an angle.

    Args:
        means: estimates (..., n or more), those of the plant's states first.
        states: truth (..., n).
        angles: which of the n states wrap at 2 pi; none by default.
    """
    errors = means[..., : states.shape[-1]] - states
    for i in np.flatnonzero(angles):
        errors[..., i] = np.pi - (np.pi - errors[..., i]) % (2.0 * np.pi)
    return errors
