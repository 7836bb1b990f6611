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
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from thruster_env.core.angles import wrapped

TOLERANCE = 0.1  # of the sample time: stamps so close to a multiple of it are it
CLOSE = 1e-9  # in steps: rounding
MOST_DIGITS = 9  # of a sample time
MOST_HELD = 5  # missing rows in a row over which an input is held; more are a gap
SURE = 4.0  # standard errors of a sample time within which it is rounded
SAME_RATE = 0.25  # of a step, over a piece: a sample time that is given is that of the stamps
NEIGHBOURS = 1.5  # steps: samples that are farther apart are not interpolated


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
    moved: np.ndarray = np.empty(0)  # (rows of the file,) [s], how far stamps were from the grid


def grid_of(stamps: np.ndarray, dt: float | None = None, clock: np.ndarray | None = None) -> Grid:
    """The grid of non-decreasing stamps [s], with the requested sample time or the one of the stamps.

    Args:
        stamps: (rows,).
        dt: sample time [s].
        clock: rows whose stamps the grid is made for (rows,), the first among them; the others are shifted as the
            stamps around them are. All rows by default.
    """
    if clock is not None and not clock.all():
        since, own = stamps - stamps[0], grid_of(stamps[clock], dt)
        times = since + np.interp(since, since[clock], own.times - since[clock])
        times[clock] = own.times
        return own._replace(times=np.maximum.accumulate(times), irregular=True)
    since, place = np.unique(stamps - stamps[0], return_inverse=True)
    usual = _usual(since)
    pieces = _pieces(since, usual)
    found, spread = _slope(since, pieces, usual)
    if dt is None:
        dt = _rounded(found, spread)
    longest = max(len(piece) for piece in pieces)
    times = since
    if (
        abs(dt - found) * longest <= SAME_RATE * dt + SURE * spread * longest
    ):  # else a piece has no place of its own
        times = _shifted(since, pieces, dt)
    numbers = np.floor(times / dt + 0.5)
    regular = bool((abs(times - dt * numbers) <= TOLERANCE * dt).all() and (np.diff(numbers) > 0).all())
    moved = abs(since - dt * numbers)[place]
    if regular:
        return Grid(dt, int(numbers[-1]) + 1, (dt * numbers)[place], False, moved)
    return Grid(dt, int(numbers[-1]) + 1, times[place], True, moved)


def _usual(since: np.ndarray) -> float:
    """About the sample time: the median interval, of stamps 1, 2, 4, ... apart, for jitter counts less there."""
    usual, lag = float(np.median(np.diff(since))), 2
    while lag <= len(since) // 4:
        apart = since[lag:] - since[:-lag]
        usual = float(np.median(apart / np.maximum(np.round(apart / usual), 1.0)))
        lag *= 2
    return usual


def _pieces(since: np.ndarray, dt: float) -> list[np.ndarray]:
    """Places of the stamps between pauses."""
    return np.split(np.arange(len(since)), np.flatnonzero(np.diff(since) > (MOST_HELD + 1.5) * dt) + 1)


def _slope(since: np.ndarray, pieces: list[np.ndarray], dt: float) -> tuple[float, float]:
    """The sample time by least squares with a beginning for each piece, and its standard error."""
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
    found = products / squares
    errors = sum(float(((t - found * k) ** 2).sum()) for k, t in centred)
    return found, float(np.sqrt(errors / max(len(since) - len(pieces) - 1, 1) / squares))


def _rounded(found: float, spread: float) -> float:
    """A sample time with no more digits than it is known to."""
    for digits in range(1, MOST_DIGITS):
        short = float(f"{found:.{digits}g}")
        if abs(short - found) <= SURE * spread + CLOSE * found:
            return short
    return float(f"{found:.{MOST_DIGITS}g}")


def _shifted(since: np.ndarray, pieces: list[np.ndarray], dt: float) -> np.ndarray:
    """Stamps of each piece, shifted by the same part of a step onto the grid; the first time is on row 0."""
    times = since.copy()
    for piece in pieces:
        own = times[piece]
        about = own[0] - dt * np.round(own[0] / dt)
        off = own - about
        times[piece] = own - about - float(np.median(off - dt * np.round(off / dt)))
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
    one, other = series.values[after - 1], series.values[after]
    between = one + share * wrapped(other - one) if angle else (1.0 - share) * one + share * other
    return np.where(near, between, out)


def held(series: Series, dt: float, steps: int, offset: float = 0.0, angle: bool = False) -> np.ndarray:
    """An input, maybe an angle, on the grid, (steps,): its mean over each step, held from sample to sample."""
    times, values = (series.times - offset) / dt, series.values
    starts = np.arange(steps + 1, dtype=np.float64)
    if _lies_on_grid(times):
        place = np.searchsorted(np.round(times), starts[:-1], side="right") - 1
        return values[np.maximum(place, 0)]
    places = np.maximum(np.searchsorted(times, starts[:-1], side="right") - 1, 0)
    if angle:
        values = np.unwrap(values)
    ends = np.append(times[1:], max(times[-1], steps) + 1.0)
    knots = np.append(min(times[0], 0.0) - 1.0, np.append(times, ends[-1]))
    heights = np.append(values[0], values)
    integral = np.append(0.0, np.cumsum(heights * np.diff(knots)))
    means = np.diff(np.interp(starts, knots, integral))
    return means - (values - series.values)[places] if angle else means


def _lies_on_grid(times: np.ndarray) -> bool:
    """Whether times in steps are whole numbers but for rounding."""
    return bool((abs(times - np.round(times)) <= CLOSE * np.maximum(1.0, abs(times))).all())
