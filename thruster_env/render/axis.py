"""Vertical axes with round ends."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from thruster_env.render.canvas import Canvas, number

ROUND = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0)  # ends of an axis, up to powers of ten
LEAST = 0.02  # ends of an axis, of full scale, where nothing happens
MOST = 3.0  # ends of an axis, of full scale, whatever happens


class Axis(NamedTuple):
    """A vertical axis from `low`, zero or below, at the bottom to `high`, zero or above, at the top."""

    low: float
    high: float
    top: float  # [px]
    height: float  # [px]
    downward: bool = False  # with the larger values below

    def y(self, value):
        """Where a value is [px]; a value off the axis is somewhat off it, however large."""
        part = np.clip((value - self.low) / (self.high - self.low), -1, 2)
        return self.top + self.height * (part if self.downward else 1 - part)

    def label(self, canvas: Canvas, x: float) -> None:
        """Write zero and the ends, unless these are too near to it, left of x [px]."""
        for value in dict.fromkeys((0.0, self.low, self.high)):  # an end may be zero
            if not value or abs(self.y(value) - self.y(0.0)) > 9:
                canvas.text(number(value, _digits(value)), (x, self.y(value)), 10, align=1.0)


def fitting_axis(values: np.ndarray, scale: float, top: float, height: float) -> Axis:
    """An axis with all values that are numbers on it, from LEAST to MOST of full scale."""
    values = np.clip(values[np.isfinite(values)], -MOST * scale, MOST * scale)
    low, high = (float(values.min()), float(values.max())) if len(values) else (0.0, 0.0)
    least = LEAST * scale if max(-low, high) < LEAST * scale else 0.0
    return Axis(-_round_up(max(-low, least)), _round_up(max(high, least)), top, height)


def _round_up(value: float) -> float:
    """The next round number; 0 for what is not positive."""
    if not value > 0:
        return 0.0
    power = 10.0 ** math.floor(math.log10(value))
    return next((step * power for step in ROUND if step * power >= value), 10 * power)


def _digits(value: float) -> int:
    """Digits after the point that a round number needs."""
    return 0 if value == round(value) else max(1, 1 - math.floor(math.log10(abs(value))))
