"""How far one recorder's clock is ahead of another's, where both recorded the same quantity."""

from __future__ import annotations

import numpy as np

REACH, STEP = 0.15, 0.001  # offsets that are tried, to either side of zero [s]
EDGES = 0.2  # of both ends that are left out, as the shifted series has to reach over them [s]


def clock_offset(times: np.ndarray, here: np.ndarray, there: np.ndarray) -> float:
    """The offset s [s] of least sum of squares of here(t) - there(t + s).

    Args:
        times: stamps (K,) [s], the same for both series, each by its own clock.
        here: samples by the clock that counts.
        there: samples by the other clock, which are interpolated linearly.
    """
    counted = (times >= times[0] + EDGES) & (times <= times[-1] - EDGES) & np.isfinite(here)
    offsets = np.arange(-REACH, REACH + STEP / 2, STEP)
    known = np.isfinite(there)
    shifted = (np.interp(times[counted] + s, times[known], there[known]) for s in offsets)
    return float(offsets[np.argmin([((here[counted] - one) ** 2).mean() for one in shifted])])


def offset_by_halves(times: np.ndarray, here: np.ndarray, there: np.ndarray) -> tuple[float, float]:
    """The offset that each half of a run has by itself: how far they are apart tells how well it is known."""
    middle = len(times) // 2
    halves = slice(None, middle), slice(middle, None)
    first, last = (clock_offset(times[half], here[half], there[half]) for half in halves)
    return first, last
