"""Formats of numbers in tables and statements."""

from __future__ import annotations

import math

from filters.consistency.intervals import Interval


def digits(value: float) -> str:
    """Three digits, thousands apart; nothing for NaN."""
    if math.isnan(value):
        return ""
    rounded = float(f"{value:.3g}")
    return f"{rounded:,.0f}".replace(",", " ") if 1000 <= abs(rounded) < 1e15 else f"{rounded:g}"


def with_interval(one: Interval) -> str:
    """A value with its interval; nothing for NaN."""
    return "" if math.isnan(one.value) else f"{digits(one.value)} [{digits(one.low)}, {digits(one.high)}]"
