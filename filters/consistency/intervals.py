"""Estimates with 95 % intervals, by bootstrap over whole runs: steps of one run are not independent, runs are."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

RESAMPLES = 2000  # bootstrap resamples of whole runs
SLIGHT = 0.005  # difference of a ratio from 1 that makes practically none
MORE_DIGITS = 3  # for an interval whose ends would else be the same number


class Interval(NamedTuple):
    """An estimate with its 95 % interval; NaN where there is nothing to estimate."""

    value: float
    low: float
    high: float

    def covers(self, number: float) -> bool:
        """Whether a number lies in the interval."""
        return self.low <= number <= self.high


def slightly(ratio: Interval) -> str:
    """By how much a ratio differs from 1, "0.02 %", where that is significant but small; empty otherwise.

    A difference below 0.5 % is no reason to prefer a filter, however sure it is.
    """
    percent = 100.0 * abs(ratio.value - 1.0)
    if ratio.covers(1.0) or not percent < 100.0 * SLIGHT:
        return ""
    return f"{percent:.1g} %" if percent >= 1e-4 else "less than 0.0001 %"


def span(value: Interval, digits: int, unit: str = "", sign: str = "") -> str:
    """A value with its 95 % interval in brackets, such as "26 % [25, 27]".

    Where both ends would be the same number it has up to three more digits, and beyond these no brackets.

    Args:
        value: with its ends.
        digits: decimals.
        unit: after the value, with its space.
        sign: "+" for signs before positive numbers, too.
    """
    for places in range(digits, digits + MORE_DIGITS + 1):
        middle, low, high = (f"{round(part, places) + 0.0:{sign}.{places}f}" for part in value)  # no -0.00
        if low != high:
            return f"{middle}{unit} [{low}, {high}]"
    return f"{value.value:{sign}.{digits}f}{unit}"


def interval(value: float, resampled: np.ndarray) -> Interval:
    """A value with the middle 95 % of its bootstrap resamples."""
    low, high = np.quantile(resampled, [0.025, 0.975])
    return Interval(float(value), float(low), float(high))


def without_interval(value: float) -> Interval:
    """A value without its interval, which takes longer to compute than the value."""
    return Interval(float(value), np.nan, np.nan)


def mean_interval(values: np.ndarray, resample: bool = True) -> Interval:
    """Mean of some numbers a run, (B,) or (B, T), with its interval if asked for; NaN entries are not there."""
    values = np.reshape(values, (len(values), -1))
    present = ~np.isnan(values)
    if not present.any():
        return Interval(np.nan, np.nan, np.nan)
    totals, counts = np.where(present, values, 0.0).sum(axis=1), present.sum(axis=1).astype(np.float64)
    value = totals.sum() / counts.sum()
    return interval(value, ratio_of_resampled(totals, counts)) if resample else without_interval(value)


def ratio_of_resampled(totals: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Sums of totals (B, ...) over sums of counts, (B,) or (B, 1), for resamples of the runs.

    Resamples that pick only runs without any count are left out.
    """
    above, below = resampled_means(totals), resampled_means(counts)
    some = below.reshape(len(below)) > 0
    return above[some] / below[some]


def rmse_intervals(
    mean_squares: np.ndarray, resample: bool = True, weights: np.ndarray | None = None
) -> tuple[Interval, ...]:
    """RMSE of every state with its interval if asked for, from mean square errors of runs (B, n).

    Runs of different lengths are pooled by their weights (B,), the numbers of their steps.
    """
    rmse = np.sqrt(pooled_mean(mean_squares, weights))
    if not resample:
        return tuple(map(without_interval, rmse))
    resampled = np.sqrt(resampled_means(mean_squares, weights))
    return tuple(interval(rmse[i], resampled[:, i]) for i in range(len(rmse)))


def rmse_ratios(a: np.ndarray, b: np.ndarray, weights: np.ndarray | None = None) -> tuple[Interval, ...]:
    """RMSE of filter a over that of filter b by state, paired by run, from mean square errors (B, n).

    Both are resampled by the same runs, so what makes a run hard for both cancels. Weights (B,) are those of the
    runs, as `rmse_intervals` takes them.

    Raises:
        ValueError: if the two have not the same number of runs and states.
    """
    if np.shape(a) != np.shape(b):
        raise ValueError(
            f"a paired comparison needs the same runs and states, but got {np.shape(a)}, {np.shape(b)}"
        )
    ratios = np.sqrt(resampled_means(a, weights) / resampled_means(b, weights))
    values = np.sqrt(pooled_mean(a, weights) / pooled_mean(b, weights))
    return tuple(interval(values[i], ratios[:, i]) for i in range(len(values)))


def pooled_mean(values: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
    """Mean over runs of values (B, n), (n,): of runs with weights (B,) sum w v / sum w."""
    return values.mean(axis=0) if weights is None else weights @ values / weights.sum()


def resampled_means(values: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
    """Means over runs of values (B, ...) for every resample, (RESAMPLES, ...); weights as for `pooled_mean`."""
    picks = _weights(len(values))
    if weights is None:
        return picks @ values
    return (picks @ (values * weights[:, None])) / (picks @ weights)[:, None]


@lru_cache(maxsize=8)
def _weights(count: int) -> np.ndarray:
    # Row r holds how often resample r picks each run, over their number. The same in every call: paired
    # quantities stay paired, and results repeat.
    picks = np.random.default_rng(0).multinomial(count, np.full(count, 1.0 / count), size=RESAMPLES)
    return picks / count
