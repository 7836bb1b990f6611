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
from datetime import UTC, datetime
from typing import NamedTuple

import numpy as np

from thruster_env.core.angles import wrapped
from thruster_env.logs.columns import converted, parted
from thruster_env.logs.digits import doubt_of_days, refuse_clock_digits, seconds_in_digits, seconds_of_dates

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

# Of the times of a column.
SINCE_1970 = (6e8, 4.1e9)  # [s]: times from 1989 to 2099, which no clock that starts with its recorder reaches
SECOND = "s"
TICKS = {"ms": 1e3, "us": 1e6, "ns": 1e9}  # a second
STAMP_NAMES = ("timestamp", "stamp")
SHORTEST_STEP, LONGEST_STEP = 1e-4, 5.0  # [s], of stamps in ms, us or ns
DOUBTED = 2.0  # [s], of whole stamps, which may as well be in ms
MOST_SECONDS = 86400.0  # [s], of stamps in seconds
DAYS, LEAST_SECONDS = 2e4, 2e-5  # stamps beyond the first are dates in days if steps are below the other [s]
STAMP_DIGITS = 17  # of a float64


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


def digits_for(largest: float, step: float, least: int) -> int:
    """Significant digits in which numbers up to `largest` differ by a tenth of `step`, at least `least`."""
    if not (0.0 < step < math.inf and 0.0 < largest < math.inf):
        return least
    return min(max(least, math.floor(math.log10(largest)) + 2 - math.floor(math.log10(step))), STAMP_DIGITS)


def time_text(seconds: float, dt: float, least: int = 6) -> str:
    """A time in as many digits as steps of dt [s] need."""
    return f"{seconds:.{digits_for(abs(seconds), dt, least)}g}"


def follows(before: float, after: float) -> str:
    """Two times that are in the wrong order: "0.07 s follows 0.08 s"."""
    texts = [time_text(time, abs(after - before), 10) for time in (after, before)]
    return f"{texts[0]} s follows {texts[1]} s"


def date_text(seconds: float) -> str:
    """The date of a time since 1970, in parentheses behind a blank; empty for any other time."""
    if not SINCE_1970[0] <= seconds <= SINCE_1970[1]:
        return ""
    return f" ({datetime.fromtimestamp(seconds, UTC).isoformat(' ', 'milliseconds').removesuffix('+00:00')} UTC)"


def unit_of(stamps: np.ndarray, header: str, where: str) -> tuple[str, str]:
    """The unit of stamps whose column names none, and what was taken, in words; empty for seconds beyond doubt.

    Stamps in ms, us or ns since 1970 are dates from 1989 to 2099 with a sample time of at most 5 s. Others are in
    seconds if these make a sample time below 1000 s (100 s in a column `timestamp`), or of whole minutes up to a
    day, or if they are not whole; of whole ones from 2 s on, which may be in ms, that is said. What is left is in
    the only unit that makes a sample time from 0.1 ms to 5 s; a column `timestamp`, as of PX4 and ROS, is never in
    ms. Dates in days, as of Excel and MATLAB, have large numbers and small steps, and are refused.

    Args:
        stamps: (rows,), NaN where there is none.
        header: of the column, without a unit.
        where: the column, for messages.

    Raises:
        ValueError: if they are not in seconds, and may be in several units.
    """
    known = stamps[np.isfinite(stamps)]
    steps = np.diff(known)
    steps = steps[steps > 0]
    if not len(steps):
        return SECOND, ""
    step, is_stamp, middle = float(np.median(steps)), header.lower() in STAMP_NAMES, float(np.median(known))
    for unit, ticks in TICKS.items():
        if SINCE_1970[0] * ticks <= middle <= SINCE_1970[1] * ticks and step <= LONGEST_STEP * ticks:
            first = date_text(float(known[0]) / ticks).strip(" ()")
            return unit, f"times in {where} are taken as {unit} since 1970: the first is {first}"
    if step < LEAST_SECONDS and abs(middle) > DAYS:
        rule = "times must be in seconds, or their column say its unit"
        way = f"use --column 'time={header}[d]' for dates in days, or [s]"
        raise ValueError(f"{rule}, but the sample time in {where} would be {step:.4g} s ({way})")
    is_whole, is_minutes = bool((known == np.round(known)).all()), not (steps % 60.0).any()
    if step <= MOST_SECONDS and (not is_whole or step < (100 if is_stamp else 1000) or is_minutes):
        is_date = SINCE_1970[0] <= middle <= SINCE_1970[1]
        if not is_whole or is_minutes or is_date or step < DOUBTED:
            return SECOND, ""
        assumption = f"the sample time is {step:.4g} s; if it is {step:.4g} ms, use --column 'time={header}[ms]'"
        return SECOND, f"times in {where} are taken as s: {assumption}"
    low, high = SHORTEST_STEP, LONGEST_STEP
    possible = [(unit, ticks) for unit, ticks in TICKS.items() if not (is_stamp and unit == "ms")]
    units = [unit for unit, ticks in possible if is_whole and low * ticks <= step <= high * ticks]
    as_seconds = f"{step:.4g} s" if step < MOST_SECONDS else f"{step / MOST_SECONDS:.3g} days"
    if len(units) != 1:
        rule = "times must be in seconds, or their column say its unit"
        way = f"use --column 'time={header}[us]', or [ns], [ms], [s]"
        raise ValueError(f"{rule}, but the sample time in {where} would be {as_seconds} ({way})")
    return units[0], f"times in {where} are taken as {units[0]}: in s the sample time would be {as_seconds}"


def in_seconds(stamps: np.ndarray, unit: str | None, header: str, where: str) -> tuple[np.ndarray, str]:
    """Stamps (rows,) of a column in a unit, and what was taken for the unit, in words.

    Without a unit they may be dates in digits (20260501), years or days in a column of dates, or what `unit_of`
    finds.
    """
    assumption = ""
    if unit is None:
        base = parted(header.rpartition(".")[2])[0]
        dates = seconds_in_digits(stamps)
        if dates is not None:
            return dates[0], f"times in {where} are taken as dates such as {dates[1]}"
        refuse_clock_digits(stamps, where)
        of_dates = seconds_of_dates(stamps, base, where)
        if of_dates is not None:
            return of_dates
        unit, assumption = unit_of(stamps, base, where)
        if unit == SECOND:
            assumption = assumption or doubt_of_days(stamps, base, where)
    return converted(stamps, unit, SECOND, where), assumption
