"""Are probabilities or ranks uniform, as they are where a forecast's whole distribution is right?"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from filters.consistency.intervals import ratio_of_resampled

POINTS = 200  # where distribution functions are compared
BARS = 20  # bars of the histogram, but one a step for up to twice as many steps
FEWEST_RUNS = 20  # fewer resample too coarsely for a test


class Uniformity(NamedTuple):
    """Values in 0 ... 1 of B runs against the uniform distribution."""

    distance: float  # Kolmogorov-Smirnov: largest difference of the two distribution functions
    p_value: float  # probability of such a distance if the values were uniform; NaN for fewer than 20 runs
    edges: np.ndarray  # (bars + 1,), of a histogram
    frequencies: np.ndarray  # (bars,), relative to uniform: 1 is right
    frequency_band: np.ndarray  # (bars, 2), their 95 % intervals


def uniformity(values: np.ndarray, steps: int = POINTS) -> Uniformity:
    """Compare the distribution of values (B, T) with the uniform one; NaN entries are left out.

    The distance is that of Kolmogorov and Smirnov. Values of one run depend on one another, so their tables do not
    hold: its probability comes from resampling whole runs, sup |F* - F| standing for sup |F - uniform|.

    Args:
        values: probabilities of B runs.
        steps: number of equally spaced points at which the distributions are compared; for ranks, their number.

    Source: Bickel, Freedman (1981), "Some asymptotic theory for the bootstrap", section 4, with runs in place of
    single values.
    """
    grid = np.linspace(0.0, 1.0, steps + 1)
    counts = np.array([np.histogram(run[~np.isnan(run)], grid)[0] for run in values], dtype=np.float64)
    totals = counts.sum(axis=1, keepdims=True)
    ends = np.linspace(0, steps, (steps if steps <= 2 * BARS else BARS) + 1).astype(int)
    edges = grid[ends]
    if not totals.any():
        nothing = np.full((len(edges) - 1, 2), np.nan)
        return Uniformity(np.nan, np.nan, edges, nothing[:, 0], nothing)
    reached = counts.cumsum(axis=1)
    found = reached.sum(axis=0) / totals.sum()
    distance = np.abs(found - grid[1:]).max()
    p_value = np.nan
    if len(values) >= FEWEST_RUNS:
        by_chance = np.abs(ratio_of_resampled(reached, totals) - found).max(axis=1)
        p_value = float((by_chance >= distance).mean())
    bars = np.add.reduceat(counts, ends[:-1], axis=1)
    widths = np.diff(edges)
    band = np.quantile(ratio_of_resampled(bars, totals), [0.025, 0.975], axis=0) / widths
    return Uniformity(float(distance), p_value, edges, bars.sum(axis=0) / totals.sum() / widths, band.T)
