"""Time stamps: dates, as seconds since the first one, and the digits in which times are written."""

from __future__ import annotations

import math
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta

import numpy as np

from thruster_env.logs.units import converted, parted

MISSING = "nan"
SINCE_1970 = (6e8, 4.1e9)  # [s]: times from 1989 to 2099, which no clock that starts with its recorder reaches
SECOND = "s"
TICKS = {"ms": 1e3, "us": 1e6, "ns": 1e9}  # a second
STAMP_NAMES = ("timestamp", "stamp")
SHORTEST_STEP, LONGEST_STEP = 1e-4, 5.0  # [s], of stamps in ms, us or ns
DOUBTED = 2.0  # [s], of whole stamps, which may as well be in ms
MOST_SECONDS = 86400.0  # [s], of stamps in seconds
DAYS, LEAST_SECONDS = 2e4, 2e-5  # stamps beyond the first are dates in days if steps are below the other [s]
MOST_DIGITS = 17  # of a float64


def since_first(dates: np.ndarray) -> np.ndarray:
    """Seconds since the first of some datetime64 or timedelta64, (rows,), NaN where there is none."""
    known = dates[~np.isnat(dates)]
    if not len(known):
        return np.full(len(dates), np.nan)
    return (dates - known[0]) / np.timedelta64(1, "s")  # whole ticks are subtracted, so that no digit is lost


def seconds_of(cells: Sequence[str]) -> np.ndarray | None:
    """Seconds since the first date of some texts, (rows,), NaN where one is none; None where no cell is a date.

    Dates with a time zone are compared in UTC, dates without one as they stand, to the microsecond.

    Args:
        cells: texts, "nan" where one is missing.

    Raises:
        ValueError: if only some dates have a time zone.
    """
    found = [None if cell == MISSING else date_of(cell) for cell in cells]
    known = [one for one in found if one is not None]
    if not known:
        return None
    if len({one.tzinfo is None for one in known}) > 1:
        raise ValueError("times must all have a time zone, or none, but got both")
    known = [one if one.tzinfo is None else one.astimezone(UTC) for one in known]
    seconds = iter([(one - known[0]) / timedelta(seconds=1) for one in known])
    return np.array([np.nan if one is None else next(seconds) for one in found])


def date_of(text: str) -> datetime | None:
    """The date that a text is as of ISO 8601, None for other text."""
    try:
        return datetime.fromisoformat(text)
    except ValueError:
        return None


def digits_for(largest: float, step: float, least: int) -> int:
    """Significant digits in which numbers up to `largest` differ by a tenth of `step`, at least `least`."""
    if not (0.0 < step < math.inf and 0.0 < largest < math.inf):
        return least
    return min(max(least, math.floor(math.log10(largest)) + 2 - math.floor(math.log10(step))), MOST_DIGITS)


def time_text(seconds: float, dt: float, least: int = 6) -> str:
    """A time in as many digits as steps of dt [s] need."""
    return f"{seconds:.{digits_for(abs(seconds), dt, least)}g}"


def follows(before: float, after: float) -> str:
    """Two times that are in the wrong order: "0.07 s follows 0.08 s"."""
    some = [time_text(one, abs(after - before), 10) for one in (after, before)]
    return f"{some[0]} s follows {some[1]} s"


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
        said = f"the sample time is {step:.4g} s; if it is {step:.4g} ms, use --column 'time={header}[ms]'"
        return SECOND, f"times in {where} are taken as s: {said}"
    low, high = SHORTEST_STEP, LONGEST_STEP
    some = [(unit, ticks) for unit, ticks in TICKS.items() if not (is_stamp and unit == "ms")]
    units = [unit for unit, ticks in some if is_whole and low * ticks <= step <= high * ticks]
    as_seconds = f"{step:.4g} s" if step < MOST_SECONDS else f"{step / MOST_SECONDS:.3g} days"
    if len(units) != 1:
        rule = "times must be in seconds, or their column say its unit"
        way = f"use --column 'time={header}[us]', or [ns], [ms], [s]"
        raise ValueError(f"{rule}, but the sample time in {where} would be {as_seconds} ({way})")
    return units[0], f"times in {where} are taken as {units[0]}: in s the sample time would be {as_seconds}"


def in_seconds(stamps: np.ndarray, unit: str | None, header: str, where: str) -> tuple[np.ndarray, str]:
    """Stamps (rows,) of a column in a unit, None for what `unit_of` finds; and what that took, in words."""
    unit, taken = (unit, "") if unit is not None else unit_of(stamps, parted(header.rpartition(".")[2])[0], where)
    return converted(stamps, unit, SECOND, where), taken
