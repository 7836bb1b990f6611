"""Fewer points than steps: what a screen of so many pixels can show of a long run."""

from __future__ import annotations

import numpy as np


def places(steps: int, width: int) -> np.ndarray:
    """Which steps are drawn on so many pixels: all, or evenly spaced ones from the first to the last."""
    if steps <= width:
        return np.arange(steps)
    return np.linspace(0, steps - 1, width).round().astype(int)


def extremes(values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Of each stretch between two places the value farthest from the mean, so that no peak is lost.

    Args:
        values: (steps,).
        at: places of `places`, (points,).

    Returns:
        (points,); NaN where a stretch has no number.
    """
    if len(at) == len(values):
        return values
    there = np.isfinite(values)
    centre = values[there].mean() if there.any() else 0.0
    away = np.where(there, np.abs(values - centre), -1.0)
    largest = np.maximum.reduceat(away, at)
    stretch = np.searchsorted(at, np.arange(len(values)), side="right") - 1
    peaks = np.flatnonzero(away == largest[stretch])
    first = peaks[np.unique(stretch[peaks], return_index=True)[1]]
    return values[first]


def corners(*lines: np.ndarray) -> np.ndarray:
    """Places that are enough to draw lines, (points,) each: those within a stretch where all are level are not."""
    same = np.ones(len(lines[0]) - 1, dtype=bool)
    for line in lines:
        same &= (line[1:] == line[:-1]) | (np.isnan(line[1:]) & np.isnan(line[:-1]))
    return np.flatnonzero(~(np.append(False, same) & np.append(same, False)))
