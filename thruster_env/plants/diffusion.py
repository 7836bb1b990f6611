"""Process noise at another sample time."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

SAME_DT = 1e-6  # relative: sample times of logs that are read off stamps


def same_dt(one: float, other: float) -> bool:
    """Whether two sample times [s] agree except for the rounding of stamps."""
    return abs(one - other) <= SAME_DT * max(abs(one), abs(other))


def noise_for_dt(process_noise_cov: ArrayLike, dt_from: float, dt_to: float) -> np.ndarray:
    """Q of a step of another sample time: Q dt_to/dt_from, that of Gaussian diffusion.

    It is exact where the states change little within a step; otherwise a first guess.

    Args:
        process_noise_cov: Q a step of `dt_from`, a matrix, variances or one.
        dt_from: sample time that it belongs to [s].
        dt_to: sample time that is wanted [s].
    """
    return np.asarray(process_noise_cov, dtype=np.float64) * (dt_to / dt_from)
