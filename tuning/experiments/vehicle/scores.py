"""Scores of a filter: mean squares by run, from which intervals and ratios follow.

NEES is the normalised estimation error squared.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from filters.consistency.intervals import Interval, interval, mean_interval, resampled_means, rmse_intervals


class Scores(NamedTuple):
    """A filter's errors in B runs; NaN where it has no estimate.

    Velocities are u, v, w [m/s] and p, q, r [rad/s], attitude is roll and pitch [rad]; both are scored from 2 s
    on, as the NEES is. A pose is x, y, z [m] and psi [rad], scored over the whole run as the papers do, it seems.
    """

    velocities: np.ndarray  # (B, 6), mean squares
    attitude: np.ndarray  # (B, 2), mean squares
    full: np.ndarray  # (B, 4), mean squares of the pose by the full transformation
    planar: np.ndarray  # (B, 4), the same by yaw alone
    planar_both: np.ndarray  # (B, 4), by yaw alone, against the path that true velocities give by yaw alone
    full_end: np.ndarray  # (B, 4), absolute errors at the end
    planar_end: np.ndarray  # (B, 4)
    nees: np.ndarray  # (B,), mean
    divergences: np.ndarray  # (B,), filter resets: restarts from the prior
    seconds: np.ndarray  # (B,), of one core

    def rmse(self, field: str) -> np.ndarray:
        """RMSE of each component of a field of mean squares."""
        return np.sqrt(getattr(self, field).mean(axis=0))

    def intervals(self, field: str) -> tuple[Interval, ...]:
        """The same with 95 % intervals by bootstrap over runs."""
        return rmse_intervals(getattr(self, field))

    @property
    def nees_interval(self) -> Interval:
        """Mean NEES with its interval."""
        return mean_interval(self.nees)


def joined(parts: Sequence[Scores]) -> Scores:
    """Scores of all runs from those of some at a time."""
    return Scores(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


def position_ratio(a: Scores, b: Scores, field: str) -> Interval:
    """RMSE of position of a over that of b on the same runs, paired, of a field of poses such as "full"."""
    above, below = (getattr(one, field)[:, :3].sum(axis=1) for one in (a, b))
    ratios = np.sqrt(resampled_means(above) / resampled_means(below))
    return interval(float(np.sqrt(above.mean() / below.mean())), ratios)
