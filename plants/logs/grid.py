"""Times of samples and the regular grid on which a log lies: the rules, all in one place.

Grid. Time stamps that lie within a tenth of a sample time of its multiples are put on these multiples: a missing
row leaves a gap. Otherwise the log is irregular, and the sample time is the one given, or the median interval.

Measurements. A sample is moved to the nearest grid time, at most half a step away; if several belong to one time,
the nearest is used; a grid time without a sample has NaN. A channel with a clock offset is interpolated linearly
between samples that are at most 1.5 steps apart, so that estimates depend continuously on the offset, as a search
for it needs; this averages some of the noise. Samples further apart are moved to the nearest grid time.

Inputs. They are held from sample to sample (before the first sample at its value); the input of a step is the mean
of the held value over the step.

Clock offsets. The offset says how far a channel's clock is ahead: its time stamp minus the offset is the log's
time.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

TOLERANCE = 0.1  # of the sample time: stamps so close to a multiple of it are it
CLOSE = 1e-9  # in steps: rounding
MOST_DIGITS = 9  # of a sample time
NEIGHBOURS = 1.5  # steps: samples that are farther apart are not interpolated


class Series(NamedTuple):
    """Samples of a channel by their times [s] since the start of the log; none is NaN."""

    times: np.ndarray
    values: np.ndarray


class Grid(NamedTuple):
    """Sample time and number of rows, and the times of the file's rows on it."""

    dt: float  # [s]
    rows: int
    times: np.ndarray  # (rows of the file,) [s] since the first one
    irregular: bool


def grid_of(stamps: np.ndarray, dt: float | None = None) -> Grid:
    """The grid of increasing stamps [s], by the sample time that is asked for or the one that they tell."""
    since, steps = stamps - stamps[0], np.diff(stamps)
    usual = float(np.median(steps)) if dt is None else dt
    numbers = np.append(0.0, np.cumsum(np.maximum(np.round(steps / usual), 1.0)))
    found = _rounded(numbers, since) if dt is None else dt
    if (abs(since - found * numbers) <= TOLERANCE * found).all():
        return Grid(found, int(numbers[-1]) + 1, found * numbers, False)
    found = float(f"{usual:.3g}") if dt is None else dt
    return Grid(found, int(since[-1] / found + 0.5) + 1, since, True)


def _rounded(numbers: np.ndarray, since: np.ndarray) -> float:
    """The sample time that stamps since the first one tell, with no more digits than they are good for."""
    found = float(numbers @ since / (numbers @ numbers))
    least = abs(since - found * numbers).max()
    for digits in range(2, MOST_DIGITS):
        short = float(f"{found:.{digits}g}")
        if abs(since - short * numbers).max() <= 2.0 * least + CLOSE * found:
            return short
    return float(f"{found:.{MOST_DIGITS}g}")


def sampled(series: Series, dt: float, rows: int, offset: float = 0.0) -> np.ndarray:
    """A measured channel on the grid, (rows,), NaN where there is no sample."""
    times = (series.times - offset) / dt
    out = np.full(rows, np.nan)
    if not len(times):
        return out
    nearest = np.floor(times + 0.5)
    order = np.argsort(-abs(times - nearest), kind="stable")
    order = order[(nearest[order] >= 0) & (nearest[order] < rows)]
    out[nearest[order].astype(int)] = series.values[order]
    if offset == 0.0 or len(times) < 2 or _lies_on_grid(times):
        return out
    grid = np.arange(rows, dtype=np.float64)
    after = np.clip(np.searchsorted(times, grid), 1, len(times) - 1)
    low, high = times[after - 1], times[after]
    near = (high - low <= NEIGHBOURS) & (low <= grid) & (grid <= high)
    apart = np.where(high > low, high - low, 1.0)
    share = (grid - low) / apart
    between = (1.0 - share) * series.values[after - 1] + share * series.values[after]
    return np.where(near, between, out)


def held(series: Series, dt: float, steps: int, offset: float = 0.0) -> np.ndarray:
    """An input on the grid, (steps,): its mean over each step, held from sample to sample."""
    times, values = (series.times - offset) / dt, series.values
    starts = np.arange(steps + 1, dtype=np.float64)
    if _lies_on_grid(times):
        place = np.searchsorted(np.round(times), starts[:-1], side="right") - 1
        return values[np.maximum(place, 0)]
    ends = np.append(times[1:], max(times[-1], steps) + 1.0)
    knots = np.append(min(times[0], 0.0) - 1.0, np.append(times, ends[-1]))
    heights = np.append(values[0], values)
    integral = np.append(0.0, np.cumsum(heights * np.diff(knots)))
    return np.diff(np.interp(starts, knots, integral))


def _lies_on_grid(times: np.ndarray) -> bool:
    """Whether times in steps are whole numbers but for rounding."""
    return bool((abs(times - np.round(times)) <= CLOSE * np.maximum(1.0, abs(times))).all())
