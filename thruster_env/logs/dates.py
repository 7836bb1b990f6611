"""Times that are written as text: dates of ISO 8601 and of spreadsheets, and clock times."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime, timedelta

import numpy as np

MISSING_TEXT = "nan"
DATES = "times must be dates as of ISO 8601, such as 2026-05-01T12:00:00.01"
HALF_DAY = 43200.0  # [s], by which a clock time falls at midnight, at least

_CLOCK = r"(?P<hour>\d{1,2}):(?P<minute>\d{2})(?::(?P<second>\d{2}(?:[.,]\d+)?))?(?:\s*(?P<half>[AaPp])[Mm])?"
_ZONE = r"(?:\s*(?P<zone>Z|UTC|GMT|[+-]\d{2}:?\d{2}))?"
_DATE = r"(?P<first>\d{1,4})(?P<mark>[-/.])(?P<middle>\d{1,2})(?:(?P=mark)(?P<last>\d{1,4}))?"
WRITTEN = re.compile(rf"{_DATE}(?:[T ,]\s*{_CLOCK}{_ZONE})?")
CLOCK = re.compile(_CLOCK)


def since_first(dates: np.ndarray) -> np.ndarray:
    """Seconds since the first of some datetime64 or timedelta64, (rows,), NaN where there is none."""
    known = dates[~np.isnat(dates)]
    if not len(known):
        return np.full(len(dates), np.nan)
    return (dates - known[0]) / np.timedelta64(1, "s")  # whole ticks are subtracted, so that no digit is lost


def date_of(text: str) -> datetime | None:
    """The date of a text in ISO 8601, None for other text."""
    try:
        return datetime.fromisoformat(text)
    except ValueError:
        return None


def seconds_of(cells: Sequence[str]) -> np.ndarray | None:
    """Seconds since the first date of some texts, (rows,), NaN where one is none; None where no cell is a date.

    Dates with a time zone are compared in UTC, dates without one as they stand, to the microsecond. Dates are as
    of ISO 8601, or else 2026-05, 2026/5/1, 1.5.2026, or 5/1/2026, whose order the numbers must tell, with a clock
    time or without; or clock times alone, 23:59:59 or 11:59:59 PM, which go on at midnight.

    Args:
        cells: texts, "nan" where one is missing.

    Raises:
        ValueError: if only some dates have a time zone, or day and month may be either.
    """
    dates = [None if cell == MISSING_TEXT else date_of(cell) for cell in cells]
    if not any(dates):
        clocks = _clock_seconds(cells)
        if clocks is not None:
            return clocks
        dates = _written_dates(cells)
    known = [date for date in dates if date is not None]
    if not known:
        return None
    if len({date.tzinfo is None for date in known}) > 1:
        raise ValueError("times must all have a time zone, or none, but got both")
    known = [date if date.tzinfo is None else date.astimezone(UTC) for date in known]
    seconds = iter([(date - known[0]) / timedelta(seconds=1) for date in known])
    return np.array([np.nan if date is None else next(seconds) for date in dates])


def is_clock(text: str) -> bool:
    """Whether a text is a clock time, 23:59 or 11:59:59 PM."""
    return CLOCK.fullmatch(text) is not None


def is_day(text: str) -> bool:
    """Whether a text is a date without a clock time."""
    match = WRITTEN.fullmatch(text)
    return match is not None and match["last"] is not None and match["hour"] is None


def joined(days: Sequence[str], clocks: Sequence[str]) -> list[str]:
    """Dates and clock times of two columns as one, missing where one is."""
    pairs = zip(days, clocks, strict=True)
    return [MISSING_TEXT if MISSING_TEXT in pair else " ".join(pair) for pair in pairs]


def _clock_seconds(cells: Sequence[str]) -> np.ndarray | None:
    """Seconds since the first clock time, each later than the one before; None unless all are clock times."""
    matches = [None if cell == MISSING_TEXT else CLOCK.fullmatch(cell) for cell in cells]
    known = [match for match in matches if match is not None]
    if not known or any(
        cell != MISSING_TEXT and match is None for cell, match in zip(cells, matches, strict=True)
    ):
        return None
    if any(match["second"] is None for match in known):  # which may be minutes and seconds
        return None
    times = np.array([np.nan if match is None else _seconds(match.groupdict()) for match in matches])
    present = ~np.isnan(times)
    days = np.cumsum(np.diff(times[present], prepend=times[present][0]) < -HALF_DAY)
    times[present] += 86400.0 * days
    return times - times[present][0]


def _seconds(clock: Mapping[str, str | None]) -> float:
    """The seconds since midnight of a match of `CLOCK`."""
    hour = int(clock["hour"] or 0)
    if clock["half"]:
        hour = hour % 12 + 12 * (clock["half"] in "Pp")
    second = float((clock["second"] or "0").replace(",", "."))
    return 3600.0 * hour + 60.0 * int(clock["minute"] or 0) + second


def _written_dates(cells: Sequence[str]) -> list[datetime | None]:
    """Dates as spreadsheets write them, None for what is none."""
    matches = [WRITTEN.fullmatch(cell) for cell in cells]
    slashed = [match for match in matches if match and match["last"] and _is_short(match) and match["mark"] != "."]
    day_first = any(int(match["first"]) > 12 for match in slashed)
    month_first = any(int(match["middle"]) > 12 for match in slashed)
    if slashed and day_first == month_first:
        text = next(cell for cell, match in zip(cells, matches, strict=True) if match is slashed[0])
        rule = f"{DATES}, or tell days from months by a day above 12"
        raise ValueError(f"{rule}, but got {text!r} with {'both orders' if day_first else 'none'}")
    return [None if match is None else _date(match, month_first) for match in matches]


def _is_short(match: re.Match[str]) -> bool:
    return len(match["first"]) <= 2


def _date(match: re.Match[str], month_first: bool) -> datetime | None:
    """The date of a match of `WRITTEN`; None if there is no such day."""
    first, middle, last = match["first"], match["middle"], match["last"]
    if last is None and len(first) == 4:
        year, month, day = int(first), int(middle), 1
    elif len(first) == 4 and last is not None:
        year, month, day = int(first), int(middle), int(last)
    elif last is not None and len(last) == 4:
        year, month, day = int(last), int(middle), int(first)
        if month_first and match["mark"] != ".":
            month, day = day, month
    else:
        return None
    zone = (match["zone"] or "").replace("UTC", "Z").replace("GMT", "Z")
    midnight = date_of(f"{year:04d}-{month:02d}-{day:02d}T00:00:00{zone}")
    if midnight is None or match["hour"] is None:
        return midnight
    return midnight + timedelta(seconds=_seconds(match.groupdict()))
