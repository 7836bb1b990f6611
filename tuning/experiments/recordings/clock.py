"""The offset between the clocks of two recorders of the same quantity."""

from __future__ import annotations

import numpy as np

REACH, STEP = 0.15, 0.001  # range of offsets to either side of zero, and its step [s]
EDGES = 0.2  # left out at both ends, so that the shifted series covers all samples [s]


def clock_offset(times: np.ndarray, here: np.ndarray, there: np.ndarray) -> float:
    """The offset s [s] of least sum of squares of here(t) - there(t + s).

    Args:
        times: stamps (K,) [s], the same for both series, each by its own clock.
        here: samples by the reference clock.
        there: samples by the other clock, which are interpolated linearly.
    """
    counted = (times >= times[0] + EDGES) & (times <= times[-1] - EDGES) & np.isfinite(here)
    offsets = np.arange(-REACH, REACH + STEP / 2, STEP)
    known = np.isfinite(there)
    shifted = (np.interp(times[counted] + s, times[known], there[known]) for s in offsets)
    return float(offsets[np.argmin([((here[counted] - one) ** 2).mean() for one in shifted])])


def offset_by_halves(times: np.ndarray, here: np.ndarray, there: np.ndarray) -> tuple[float, float]:
    """The offset of each half of a run: their difference shows the accuracy."""
    middle = len(times) // 2
    halves = slice(None, middle), slice(middle, None)
    first, last = (clock_offset(times[half], here[half], there[half]) for half in halves)
    return first, last
