"""Intervals by bootstrap over runs, tests of uniformity, and scores of probabilistic estimates."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

RESAMPLES = 2000  # bootstrap resamples of whole runs
SLIGHT = 0.005  # difference of a ratio from 1 that makes practically none
MORE_DIGITS = 3  # for an interval whose ends would else be the same number
POINTS = 200  # where distribution functions are compared
BARS = 20  # bars of the histogram, but one a step for up to twice as many steps
FEWEST_RUNS = 20  # fewer resample too coarsely for a test
LEVELS = np.arange(0.05, 1.0, 0.05)  # of intervals whose coverage is looked at


# Estimates with 95 % intervals, by bootstrap over whole runs: steps of one run are not independent, runs are.


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

    A difference below 0.5 % is no reason to prefer a filter, however significant it is.
    """
    percent = 100.0 * abs(ratio.value - 1.0)
    if ratio.covers(1.0) or not percent < 100.0 * SLIGHT:
        return ""
    return f"{percent:.1g} %" if percent >= 1e-4 else "less than 0.0001 %"


def span(value: Interval, digits: int, unit: str = "", sign: str = "") -> str:
    """A value with its 95 % interval in brackets, such as "26 % [25, 27]".

    If both ends would read the same it has up to three more digits, and if they still do, no brackets.

    Args:
        value: with its ends.
        digits: decimals.
        unit: after the value, with its space.
        sign: "+" for signs before positive numbers, too.
    """
    for decimals in range(digits, digits + MORE_DIGITS + 1):
        middle, low, high = (f"{round(part, decimals) + 0.0:{sign}.{decimals}f}" for part in value)  # no -0.00
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
    """Mean of values by run, (B,) or (B, T), with its interval if asked for; NaN entries do not count."""
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
    counted = below.reshape(len(below)) > 0
    return above[counted] / below[counted]


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

    Both are resampled by the same runs, so difficulties that a run has for both cancel. Weights (B,) are those of
    the runs, as `rmse_intervals` takes them.

    Raises:
        ValueError: if their numbers of runs or states differ.
    """
    if np.shape(a) != np.shape(b):
        rule = "a paired comparison needs the same runs and states"
        raise ValueError(f"{rule}, but got {np.shape(a)}, {np.shape(b)}")
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


# Are probabilities or ranks uniform, as they are where a forecast's whole distribution is right?


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
    cumulative = reached.sum(axis=0) / totals.sum()
    distance = np.abs(cumulative - grid[1:]).max()
    p_value = np.nan
    if len(values) >= FEWEST_RUNS:
        by_chance = np.abs(ratio_of_resampled(reached, totals) - cumulative).max(axis=1)
        p_value = float((by_chance >= distance).mean())
    bars = np.add.reduceat(counts, ends[:-1], axis=1)
    widths = np.diff(edges)
    band = np.quantile(ratio_of_resampled(bars, totals), [0.025, 0.975], axis=0) / widths
    return Uniformity(float(distance), p_value, edges, bars.sum(axis=0) / totals.sum() / widths, band.T)


# Scores of probabilistic estimates: coverage, CRPS (continuous ranked probability score) and ranks.


def covered(errors: np.ndarray, deviations: np.ndarray, level: float = 0.95) -> np.ndarray:
    """1 where an error lies in its Gaussian interval of a level, else 0; NaN without a positive deviation."""
    from scipy.special import ndtri  # which takes a third of a second

    reach = ndtri(0.5 + 0.5 * level)
    return np.where((deviations > 0) & ~np.isnan(errors), np.abs(errors) <= reach * deviations, np.nan)


def gaussian_crps(errors: np.ndarray, deviations: np.ndarray) -> np.ndarray:
    """Continuous ranked probability score of N(mean, deviation^2), from errors mean - truth of the same shape.

        s (z (2 Phi(z) - 1) + 2 phi(z) - 1/sqrt(pi)),  z = e/s;  |e| for s = 0

    It has the unit of the state, is smallest on average for the true distribution, and equals the absolute error
    if the standard deviation is zero. If the forecast distribution is correct, its mean is s/sqrt(pi).

    Source: Gneiting, Raftery (2007), "Strictly proper scoring rules, prediction, and estimation", section 4.2.
    """
    positive = np.where(deviations > 0, deviations, 1.0)
    z = errors / positive
    density = np.exp(-0.5 * z * z) / np.sqrt(2.0 * np.pi)
    from scipy.special import ndtr

    score = positive * (z * (2.0 * ndtr(z) - 1.0) + 2.0 * density - 1.0 / np.sqrt(np.pi))
    return np.where(deviations > 0, score, np.abs(errors))


def expected_gaussian_crps(deviations: np.ndarray) -> np.ndarray:
    """Mean CRPS of a Gaussian forecast if it is right: s/sqrt(pi)."""
    return deviations / np.sqrt(np.pi)


def ensemble_crps(
    truth: np.ndarray, members: np.ndarray, weights: np.ndarray | None = None, *, fair: bool = False
) -> np.ndarray:
    """Continuous ranked probability score of ensembles.

        sum_j w_j |x_j - y| - 1/2 sum_ij w_i w_j |x_i - x_j|

    Args:
        truth: y, (...,).
        members: x, (..., N).
        weights: w, (..., N) with sum 1; equal if None.
        fair: divide the second sum of an unweighted ensemble by N (N - 1) in place of N^2, which makes the mean
            score what an infinite ensemble of the same distribution would have.

    Raises:
        ValueError: if fair is asked of weighted members.

    Source: Gneiting, Raftery (2007), equation (21); fair: Ferro (2014), "Fair scores for ensemble forecasts".
    """
    if fair and weights is not None:
        raise ValueError("a fair score needs members without weights, but got weights")
    size = members.shape[-1]
    order = np.argsort(members, axis=-1)
    x = np.take_along_axis(members, order, axis=-1)
    w = np.full(x.shape, 1.0 / size) if weights is None else np.take_along_axis(weights, order, axis=-1)
    # In ascending order sum_ij w_i w_j |x_i - x_j| / 2 is a sum over gaps: weight below times weight above.
    below = w.cumsum(axis=-1)[..., :-1]
    spread = (below * (1.0 - below) * np.diff(x, axis=-1)).sum(axis=-1)
    if fair:
        spread = spread * size / (size - 1.0)
    return (w * np.abs(x - truth[..., None])).sum(axis=-1) - spread


def ensemble_ranks(truth: np.ndarray, members: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
    """Where the truth (...,) stands among members (..., N), as (rank + 1/2)/(N + 1) in 0 ... 1.

    The rank is the number of members below the truth, 0 ... N; with weights (..., N) it is N times their weight.
    NaN where there is no truth.
    For a consistent ensemble all ranks are equally likely. Source: Hamill (2001), "Interpretation of rank
    histograms for verifying ensemble forecasts".
    """
    size = members.shape[-1]
    below = members < truth[..., None]
    rank = below.sum(axis=-1) if weights is None else size * (weights * below).sum(axis=-1)
    return np.where(np.isnan(truth), np.nan, (rank + 0.5) / (size + 1.0))
