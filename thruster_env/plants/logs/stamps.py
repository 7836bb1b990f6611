"""Time stamps that are dates, datetime64 or text of ISO 8601, as seconds since the first one."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime, timedelta

import numpy as np

MISSING = "nan"


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
