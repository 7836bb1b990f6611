"""Time stamps: dates, as seconds since the first one, and the digits in which times are written."""

from __future__ import annotations

import math
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta

import numpy as np

MISSING = "nan"
SINCE_1970 = (6e8, 4.1e9)  # [s]: times from 1989 to 2099, which no clock that starts with its recorder reaches
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
