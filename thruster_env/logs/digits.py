"""Dates and clock times that are written as numbers: 20260501, 20260501123000, decimal years, days of Excel."""

from __future__ import annotations

import numpy as np

LEAST_DATES = 3  # numbers that are to be dates
YEARS = 1900, 2100  # of dates in digits
LATEST = 2035  # with hours alone, beyond which they are seconds since 1970, too
WIDTHS = {8: "20260501", 10: "2026050112", 12: "202605011200", 14: "20260501120000"}  # digits, and such a date
DATES = ("date", "datum", "year", "jahr")  # columns whose numbers are no seconds
CALENDAR = 1500.0, 2200.0  # years as numbers
DAYS = (20e3, 80e3), (6e5, 8e5), (2.3e6, 2.6e6)  # Excel's and modified Julian ones, MATLAB's, Julian ones
DAY, YEAR = 86400.0, 365.25 * 86400.0  # s
ROUNDING = 0.1  # s, of days with six decimals


def seconds_in_digits(stamps: np.ndarray) -> tuple[np.ndarray, str] | None:
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


def refuse_clock_digits(stamps: np.ndarray, where: str) -> None:
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


def seconds_of_dates(stamps: np.ndarray, base: str, where: str) -> tuple[np.ndarray, str] | None:
    """Seconds of numbers (rows,) in a column of dates or years, and their unit in words; None in other columns.

    They are years, days of Excel, MATLAB or Julius Scaliger, or else seconds, which is said.
    """
    known = stamps[np.isfinite(stamps)]
    if base.lower() not in DATES or not len(known) or known.max() > max(high for _, high in DAYS):
        return None
    for (low, high), unit, name in ((CALENDAR, YEAR, "years"), *((ends, DAY, "days") for ends in DAYS)):
        if low <= known.min() and known.max() <= high:
            seconds = unit * stamps
            rounded = np.round(seconds)
            is_rounding = np.nanmax(np.abs(seconds - rounded)) < ROUNDING
            return rounded if is_rounding else seconds, f"times in {where} are taken as {name}"
    return stamps, f"times in {where} are taken as s; if they are days, use --column 'time={base}[d]'"


def doubt_of_days(stamps: np.ndarray, base: str, where: str) -> str:
    """What to say of stamps taken as seconds that may be days, with steps of whole seconds; empty for others."""
    known = stamps[np.isfinite(stamps)]
    if len(known) < LEAST_DATES or not any(low <= known.min() and known.max() <= high for low, high in DAYS):
        return ""
    step = float(np.median(np.diff(known)))
    seconds, thousandths = DAY * step, 1e3 * step
    is_decimal = abs(thousandths - round(thousandths)) < 1e-3
    if is_decimal or seconds < 1.0 or abs(seconds - round(seconds)) > ROUNDING:
        return ""
    as_days = f"if they are days, as of Excel and MATLAB, it is {round(seconds)} s: use --column 'time={base}[d]'"
    return f"times in {where} are taken as s: the sample time is {step:.4g} s; {as_days}"
