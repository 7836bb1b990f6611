"""Times of a column as seconds: numbers in a unit, dates in digits or days, texts; and how times are written.

Numbers without a unit are seconds, unless `unit_of` finds another one, or they are dates: 20260501, years, days of
Excel. Texts are dates of ISO 8601 or as spreadsheets write them, or clock times.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime, timedelta

import numpy as np

from thruster_env.logs.columns import converted, parted

SINCE_1970 = (6e8, 4.1e9)  # [s]: times from 1989 to 2099, which no clock that starts with its recorder reaches
SECOND = "s"
TICKS = {"ms": 1e3, "us": 1e6, "ns": 1e9}  # a second
STAMP_NAMES = ("timestamp", "stamp")
SHORTEST_STEP, LONGEST_STEP = 1e-4, 5.0  # [s], of stamps in ms, us or ns
DOUBTED = 2.0  # [s], of whole stamps, which may as well be in ms
DAY, YEAR = 86400.0, 365.25 * 86400.0  # s
MOST_SECONDS = DAY  # [s], of stamps in seconds
LEAST_DAYS, LEAST_SECONDS = 2e4, 2e-5  # stamps beyond the first are dates in days if steps are below the other [s]
STAMP_DIGITS = 17  # of a float64

# Of dates that are written as numbers.
LEAST_DATES = 3  # numbers that are to be dates
YEARS = 1900, 2100  # of dates in digits
LATEST = 2035  # with hours alone, beyond which they are seconds since 1970, too
WIDTHS = {8: "20260501", 10: "2026050112", 12: "202605011200", 14: "20260501120000"}  # digits, and such a date
DATE_COLUMNS = ("date", "datum", "year", "jahr")  # columns whose numbers are no seconds
CALENDAR = 1500.0, 2200.0  # years as numbers
DAYS = (20e3, 80e3), (6e5, 8e5), (2.3e6, 2.6e6)  # Excel's and modified Julian ones, MATLAB's, Julian ones
DAY_ROUNDING = 0.1  # s, of days with six decimals

# Of dates that are written as text.
MISSING_TEXT = "nan"
DATE_RULE = "times must be dates as of ISO 8601, such as 2026-05-01T12:00:00.01"
HALF_DAY = DAY / 2.0  # [s], by which a clock time falls at midnight, at least

_CLOCK = r"(?P<hour>\d{1,2}):(?P<minute>\d{2})(?::(?P<second>\d{2}(?:[.,]\d+)?))?(?:\s*(?P<half>[AaPp])[Mm])?"
_ZONE = r"(?:\s*(?P<zone>Z|UTC|GMT|[+-]\d{2}:?\d{2}))?"
_DATE = r"(?P<first>\d{1,4})(?P<mark>[-/.])(?P<middle>\d{1,2})(?:(?P=mark)(?P<last>\d{1,4}))?"
WRITTEN = re.compile(rf"{_DATE}(?:[T ,]\s*{_CLOCK}{_ZONE})?")
CLOCK = re.compile(_CLOCK)


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
    if step < LEAST_SECONDS and abs(middle) > LEAST_DAYS:
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
    as_seconds = f"{step:.4g} s" if step < DAY else f"{step / DAY:.3g} days"
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
        dates = _seconds_in_digits(stamps)
        if dates is not None:
            return dates[0], f"times in {where} are taken as dates such as {dates[1]}"
        _refuse_clock_digits(stamps, where)
        of_dates = _seconds_of_dates(stamps, base, where)
        if of_dates is not None:
            return of_dates
        unit, assumption = unit_of(stamps, base, where)
        if unit == SECOND:
            assumption = assumption or _doubt_of_days(stamps, base, where)
    return converted(stamps, unit, SECOND, where), assumption


def _seconds_in_digits(stamps: np.ndarray) -> tuple[np.ndarray, str] | None:
    """Seconds since 1970 of dates in digits (rows,), and such a date; None unless all numbers are dates.

    They are YYYYMMDD, with HH, HHMM or HHMMSS behind it: 20260131 is followed by 20260201.
    """
    known = stamps[np.isfinite(stamps)]
    if len(known) < LEAST_DATES or known.min() < 1e7:
        return None
    widths = {len(f"{end:.0f}") for end in (np.floor(known.min()), np.floor(known.max()))}
    width = widths.pop()
    integers = np.floor(stamps)
    if widths or width not in WIDTHS or width < 14 and (integers != stamps)[np.isfinite(stamps)].any():
        return None
    day, clock = np.divmod(np.nan_to_num(integers, nan=known[0] // 1.0), 10.0 ** (width - 8))
    clock *= 10.0 ** (14 - width)
    year, month, number = day // 1e4, day // 100.0 % 100.0, day % 100.0
    hour, minute, second = clock // 1e4, clock // 100.0 % 100.0, clock % 100.0
    low, high = YEARS[0], LATEST if width == 10 else YEARS[1]
    is_date = (low <= year) & (year <= high) & (1 <= month) & (month <= 12) & (1 <= number) & (number <= 31)
    if not (is_date & (hour < 24) & (minute < 60) & (second < 60)).all():
        return None
    months = (12 * (year - 1970) + month - 1).astype(np.int64).astype("datetime64[M]")
    days = months.astype("datetime64[D]") + (number - 1).astype(np.int64)
    if (days.astype("datetime64[M]") != months).any():  # the 31st of a shorter month
        return None
    seconds = DAY * days.astype(np.int64) + 3600.0 * hour + 60.0 * minute + second + (stamps - integers)
    return seconds, WIDTHS[width]


def _refuse_clock_digits(stamps: np.ndarray, where: str) -> None:
    """Raise ValueError for clock times in digits, HHMM or HHMMSS, which go from 59 to 100."""
    known = stamps[np.isfinite(stamps)]
    if len(known) < LEAST_DATES or known.min() < 0.0 or known.max() >= 24e4:
        return
    if (known % 100.0 >= 60.0).any() or (known // 100.0 % 100.0 >= 60.0).any():
        return
    seconds = known // 1e4 * 3600.0 + known // 100.0 % 100.0 * 60.0 + known % 100.0
    steps, as_written = np.diff(seconds), np.diff(known)
    longer = np.flatnonzero(~np.isclose(as_written, np.median(as_written)))
    regular = np.isclose(steps[longer], np.median(steps))
    if len(longer) > 1 and regular.mean() > 0.5:
        row = int(longer[regular][0])
        rule = "times must be numbers of one unit, or dates"
        pair = f"{known[row]:.10g} is followed by {known[row + 1]:.10g}"
        raise ValueError(
            f"{rule}, but in {where} {pair}, as clock times are: write 2026-05-01T12:59:59, or seconds"
        )


def _seconds_of_dates(stamps: np.ndarray, base: str, where: str) -> tuple[np.ndarray, str] | None:
    """Seconds of numbers (rows,) in a column of dates or years, and their unit in words; None in other columns.

    They are years, days of Excel, MATLAB or Julius Scaliger, or else seconds, which is said.
    """
    known = stamps[np.isfinite(stamps)]
    if base.lower() not in DATE_COLUMNS or not len(known) or known.max() > max(high for _, high in DAYS):
        return None
    for (low, high), unit, name in ((CALENDAR, YEAR, "years"), *((ends, DAY, "days") for ends in DAYS)):
        if low <= known.min() and known.max() <= high:
            seconds = unit * stamps
            rounded = np.round(seconds)
            is_rounding = np.nanmax(np.abs(seconds - rounded)) < DAY_ROUNDING
            return rounded if is_rounding else seconds, f"times in {where} are taken as {name}"
    return stamps, f"times in {where} are taken as s; if they are days, use --column 'time={base}[d]'"


def _doubt_of_days(stamps: np.ndarray, base: str, where: str) -> str:
    """What to say of stamps taken as seconds that may be days, with steps of whole seconds; empty for others."""
    known = stamps[np.isfinite(stamps)]
    if len(known) < LEAST_DATES or not any(low <= known.min() and known.max() <= high for low, high in DAYS):
        return ""
    step = float(np.median(np.diff(known)))
    seconds, thousandths = DAY * step, 1e3 * step
    is_decimal = abs(thousandths - round(thousandths)) < 1e-3
    if is_decimal or seconds < 1.0 or abs(seconds - round(seconds)) > DAY_ROUNDING:
        return ""
    as_days = f"if they are days, as of Excel and MATLAB, it is {round(seconds)} s: use --column 'time={base}[d]'"
    return f"times in {where} are taken as s: the sample time is {step:.4g} s; {as_days}"


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
    times[present] += DAY * days
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
        rule = f"{DATE_RULE}, or tell days from months by a day above 12"
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
