"""A period that stands out of a column of numbers, such as a day in hourly temperatures."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.ndimage import median_filter

from filters.models import MOST_HARMONICS
from tuning.series.column import Column

CHANCE = 1e-6  # that the highest of a record of noise is called a period
FACTOR = 4.0  # above what noise has by this chance: spectra of other signals are not flat
NEIGHBOURS = 41  # frequencies whose median is the level about one
FEWEST = 3  # periods in the record
MOST = 2_000_000  # rows of the grid
KNOWN = 60.0, 3600.0, 43200.0, 86400.0, 604800.0, 365.25 * 86400.0  # s, taken where the record cannot tell another


class Period(NamedTuple):
    """A period [s] and the number of its harmonics that stand out."""

    seconds: float
    harmonics: int

    @property
    def model(self) -> str:
        """The named model of a level with a course of this period."""
        count = f",harmonics={self.harmonics}" if self.harmonics > 1 else ""
        return f"constant + harmonic:period={self.seconds:.7g}{count}"


def outstanding_period(column: Column) -> Period | None:
    """The longest period whose harmonics include the highest line of the spectrum; None without a line.

    The spectrum is of differences of neighbours, as a level that walks has a flat one then. The power of white
    noise is exponentially distributed: with this chance the highest of n is above log(n/CHANCE)/log(2) medians.
    """
    times = column.times
    grid = column.dt * np.arange(math.floor(times[-1] / column.dt) + 1.0)
    if len(grid) > MOST or len(grid) < 8 * FEWEST:
        return None
    axis = int(np.nanstd(column.table, axis=0).argmax())
    known = column.measured[:, axis]
    z = np.diff(np.interp(grid, times[known], column.table[known, axis]))
    power = np.abs(np.fft.rfft((z - z.mean()) * np.hanning(len(z)))) ** 2
    level = median_filter(power, NEIGHBOURS, mode="nearest") + 1e-12 * power.max()
    heights = power / level
    heights[:FEWEST] = 0.0
    least = FACTOR * math.log(len(power) / CHANCE) / math.log(2.0)
    inner = slice(1, -1)
    is_line = np.zeros(len(power), bool)
    is_line[inner] = (power[inner] >= power[:-2]) & (power[inner] >= power[2:]) & (heights[inner] > least)
    lines = np.flatnonzero(is_line)
    if not len(lines):
        return None
    positions = np.array([_between(np.log(power[line - 1 : line + 2]), int(line)) for line in lines])
    highest = positions[int(heights[lines].argmax())]
    multiples = highest / positions
    first = positions[np.abs(multiples - np.round(multiples)) * positions < 0.5][0]
    orders = positions / first
    harmonic = [round(order) for order in orders.tolist() if abs(order - round(order)) * first < 0.5]
    seconds = len(z) * column.dt / first
    near = [period for period in KNOWN if abs(len(z) * column.dt / period - first) < 0.5]
    seconds = near[0] if near else float(f"{seconds:.5g}")
    most = min(MOST_HARMONICS, math.floor(0.5 * seconds / column.dt))
    return Period(seconds, max(order for order in harmonic if order <= most)) if most else None


def _between(logarithms: np.ndarray, line: int) -> float:
    """The position of a peak, by the parabola through its logarithm and those beside it."""
    before, at, after = logarithms.tolist()
    bend = before - 2.0 * at + after
    return line + (0.5 * (before - after) / bend if bend < 0.0 else 0.0)
