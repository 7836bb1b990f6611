"""Times of samples and the regular grid on which a log lies: the rules, all in one place.

Grid. The sample time is the one given, or the slope of the stamps over their numbers, between pauses. After a
pause stamps may lie between two times of the grid: all up to the next pause are shifted by the same part of a
step. Stamps that then lie within a tenth of a sample time of its multiples are put on these multiples: a missing
row leaves a gap. Otherwise the log is irregular.

Measurements. A sample is moved to the nearest grid time, at most half a step away; if several belong to one time,
the nearest is used; a grid time without a sample has NaN. A channel with a clock offset is interpolated linearly
between samples that are at most 1.5 steps apart, so that estimates depend continuously on the offset, as a search
for it needs; this averages some of the noise. Samples further apart are moved to the nearest grid time. Between
angles it is the short way round, on the branch of the earlier sample; so it is for the mean of an input.

Inputs. They are held from sample to sample (before the first sample at its value); the input of a step is the mean
of the held value over the step.

Clock offsets. The offset says how far a channel's clock is ahead: its time stamp minus the offset is the log's
time.

Without a grid, a row is a time at which any channel has a sample (`at_own_stamps`).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from thruster_env.core.angles import wrapped

SAME_STAMP = 1e-9  # of a sample time: two stamps that are no further apart are one
ROUNDING = 1e-6  # of a sample time: so much longer it is still one step
MOST_STEPS = 1_000_000  # from one stamp to the next; some seconds of an extended filter

# Of the grid.
TOLERANCE = 0.1  # of the sample time: stamps so close to a multiple of it are it
CLOSE_TO_GRID = 1e-9  # in steps: rounding
MOST_DIGITS = 9  # of a sample time
MOST_HELD = 5  # missing rows in a row over which an input is held; more are a gap
SURE = 4.0  # standard errors of a sample time within which it is rounded
SAME_RATE = 0.25  # of a step, over a piece: a sample time that is given is that of the stamps
NEIGHBOURS = 1.5  # steps: samples that are farther apart are not interpolated


def resolution_of(latest: float, resolution: float = 0.0) -> float:
    """The largest difference [s] that rounding makes between stamps up to the latest one.

    float64 leaves 2.4e-7 s of seconds since 1970, a recorder that writes milliseconds leaves 1 ms.

    Args:
        latest: the stamp of the largest size [s].
        resolution: that of the recorder [s]; float64's counts where it is coarser.
    """
    return max(resolution, 2.0 * math.ulp(latest))


def resolution_of_digits(times: np.ndarray, dt: float) -> float:
    """How far rounding moves stamps [s]: half a unit of the fewest digits that write all of them, or float64's."""
    least = 2.0 * math.ulp(float(np.abs(times).max())) + ROUNDING * dt
    for digits in range(-3, MOST_DIGITS):
        unit = 10.0**-digits
        if float(np.abs(times - unit * np.round(times / unit)).max()) <= least:
            return 0.5 * unit + least
    return least


def closeness(dt: float, resolution: float) -> float:
    """How far two stamps may be apart to be one [s], for a sample time dt [s] and their resolution [s]."""
    return max(SAME_STAMP * dt, resolution)


def count_steps(length: float, dt: float, resolution: float) -> int:
    """How many equal steps of at most dt [s] a time [s] is divided into, for stamps of some resolution [s].

    Both the time and dt, which is often read off stamps, are rounded, so a step that is longer than the sample
    time by no more than the rounding is one step.

    Raises ValueError for more than MOST_STEPS, as after a clock was set.
    """
    count = length / dt - max(ROUNDING, 2.0 * resolution / dt)
    if not count <= MOST_STEPS:
        rule = f"two successive stamps must be at most {MOST_STEPS} steps of {dt:g} s apart"
        raise ValueError(f"{rule}, but are {length:.9g} s: after a gap or a clock that was set start anew")
    return max(1, math.ceil(count))


class Series(NamedTuple):
    """Samples of a channel by their times [s] since the start of the log; none is NaN."""

    times: np.ndarray
    values: np.ndarray


class Grid(NamedTuple):
    """Sample time and number of rows, and the times of the file's rows on it."""

    dt: float  # [s]
    rows: int
    times: np.ndarray  # (rows of the file,) [s] since row 0
    irregular: bool
    shifts: np.ndarray = np.empty(0)  # (rows of the file,) [s], how far stamps were from the grid


def grid_of(stamps: np.ndarray, dt: float | None = None, clock: np.ndarray | None = None) -> Grid:
    """The grid of non-decreasing stamps [s], with the requested sample time or the one of the stamps.

    Args:
        stamps: (rows,).
        dt: sample time [s].
        clock: rows whose stamps the grid is made for (rows,), the first among them; the others are shifted as the
            stamps around them are. All rows by default.
    """
    if clock is not None and not clock.all():
        since, clocked = stamps - stamps[0], grid_of(stamps[clock], dt)
        times = since + np.interp(since, since[clock], clocked.times - since[clock])
        times[clock] = clocked.times
        return clocked._replace(times=np.maximum.accumulate(times), irregular=True)
    since, inverse = np.unique(stamps - stamps[0], return_inverse=True)
    usual = _usual(since)
    pieces = _pieces(since, usual)
    period, spread = _slope(since, pieces, usual)
    if dt is None:
        dt = _rounded(period, spread)
    longest = max(len(piece) for piece in pieces)
    times = since
    if abs(dt - period) * longest <= SAME_RATE * dt + SURE * spread * longest:  # else no piece has its own place
        times = _shifted(since, pieces, dt)
    numbers = np.floor(times / dt + 0.5)
    regular = bool((abs(times - dt * numbers) <= TOLERANCE * dt).all() and (np.diff(numbers) > 0).all())
    shifts = abs(since - dt * numbers)[inverse]
    times = dt * numbers if regular else times
    return Grid(dt, int(numbers[-1]) + 1, times[inverse], not regular, shifts)


def _usual(since: np.ndarray) -> float:
    """The approximate sample time: the median interval of stamps 1, 2, 4, ... apart, less affected by jitter."""
    usual, lag = float(np.median(np.diff(since))), 2
    while lag <= len(since) // 4:
        apart = since[lag:] - since[:-lag]
        usual = float(np.median(apart / np.maximum(np.round(apart / usual), 1.0)))
        lag *= 2
    return usual


def _pieces(since: np.ndarray, dt: float) -> list[np.ndarray]:
    """Indices of the stamps between pauses."""
    return np.split(np.arange(len(since)), np.flatnonzero(np.diff(since) > (MOST_HELD + 1.5) * dt) + 1)


def _slope(since: np.ndarray, pieces: list[np.ndarray], dt: float) -> tuple[float, float]:
    """The sample time by least squares with a phase for each piece, and its standard error."""
    products = squares = errors = 0.0
    centred = []
    for piece in pieces:
        times = since[piece] - since[piece[0]]
        phase = float(np.median(times - dt * np.round(times / dt)))
        numbers = np.round((times - phase) / dt)
        centred.append((numbers - numbers.mean(), times - times.mean()))
        products += float(centred[-1][0] @ centred[-1][1])
        squares += float(centred[-1][0] @ centred[-1][0])
    if squares == 0.0:
        return dt, 0.0
    period = products / squares
    errors = sum(float(((t - period * k) ** 2).sum()) for k, t in centred)
    return period, float(np.sqrt(errors / max(len(since) - len(pieces) - 1, 1) / squares))


def _rounded(period: float, spread: float) -> float:
    """A sample time with no more digits than it is known to."""
    for digits in range(1, MOST_DIGITS):
        short = float(f"{period:.{digits}g}")
        if abs(short - period) <= SURE * spread + CLOSE_TO_GRID * period:
            return short
    return float(f"{period:.{MOST_DIGITS}g}")


def _shifted(since: np.ndarray, pieces: list[np.ndarray], dt: float) -> np.ndarray:
    """Stamps of each piece, shifted by the same part of a step onto the grid; the first time is on row 0."""
    times = since.copy()
    for piece in pieces:
        piece_times = times[piece]
        about = piece_times[0] - dt * np.round(piece_times[0] / dt)
        off = piece_times - about
        times[piece] = piece_times - about - float(np.median(off - dt * np.round(off / dt)))
    return times - dt * np.floor(times[0] / dt + 0.5)


def sampled(series: Series, dt: float, rows: int, offset: float = 0.0, angle: bool = False) -> np.ndarray:
    """A measured channel, maybe an angle [rad], on the grid, (rows,), NaN where there is no sample."""
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
    before, other = series.values[after - 1], series.values[after]
    between = before + share * wrapped(other - before) if angle else (1.0 - share) * before + share * other
    return np.where(near, between, out)


def mean_held(series: Series, dt: float, steps: int, offset: float = 0.0, angle: bool = False) -> np.ndarray:
    """An input, maybe an angle, on the grid, (steps,): its mean over each step, held from sample to sample."""
    times, values = (series.times - offset) / dt, series.values
    starts = np.arange(steps + 1, dtype=np.float64)
    if _lies_on_grid(times):
        sample = np.searchsorted(np.round(times), starts[:-1], side="right") - 1
        return values[np.maximum(sample, 0)]
    samples = np.maximum(np.searchsorted(times, starts[:-1], side="right") - 1, 0)
    if angle:
        values = np.unwrap(values)
    ends = np.append(times[1:], max(times[-1], steps) + 1.0)
    knots = np.append(min(times[0], 0.0) - 1.0, np.append(times, ends[-1]))
    heights = np.append(values[0], values)
    integral = np.append(0.0, np.cumsum(heights * np.diff(knots)))
    means = np.diff(np.interp(starts, knots, integral))
    return means - (values - series.values)[samples] if angle else means


def _lies_on_grid(times: np.ndarray) -> bool:
    """Whether times in steps are whole numbers up to rounding."""
    return bool((abs(times - np.round(times)) <= CLOSE_TO_GRID * np.maximum(1.0, abs(times))).all())
