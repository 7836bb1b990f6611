"""What an estimate is off by: the one place where errors are formed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from numerics.angles import difference


def state_errors(means: np.ndarray, states: np.ndarray, angles: Sequence[bool] = ()) -> np.ndarray:
    """Estimates less truth, (..., n), angles the short way round: e = mean - x, in (-pi, pi] for an angle.

    Args:
        means: estimates (..., n or more), those of the plant's states first.
        states: truth (..., n).
        angles: which of the n states wrap at 2 pi; none by default.
    """
    return difference(means[..., : states.shape[-1]], states, angles)
