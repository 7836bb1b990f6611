"""Is a filter's covariance consistent? NEES, NIS, the whiteness of innovations, and models that blow up.

NEES is the normalised estimation error squared, e' P^-1 e, NIS the normalised innovation squared, v' S^-1 v.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from math import isfinite
from typing import NamedTuple

import numpy as np
from scipy.special import chdtr, chdtrc, chdtri, stdtrit

from thruster_env.core.checks import at_least
from thruster_env.core.parallel import spread

RESAMPLES = 2000  # bootstrap resamples of whole runs
SLIGHT = 0.005  # difference of a ratio from 1 that makes practically none
MORE_DIGITS = 3  # for an interval whose ends would else be the same number
POINTS = 200  # where distribution functions are compared
BARS = 20  # bars of the histogram, but one a step for up to twice as many steps
FEWEST_RUNS = 20  # fewer resample too coarsely for a test
FEW_RUNS = 10  # from which resamples vary nearly as much as means do: their intervals cover 90 % and more
POSITIVE, SHARE = (0.0, np.inf), (0.0, 1.0)  # limits of what a mean can be
LEVELS = np.arange(0.05, 1.0, 0.05)  # of intervals whose coverage is looked at


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


def interval(value: float, resampled: np.ndarray, runs: int, is_ratio: bool = False) -> Interval:
    """A value with the middle 95 % of its bootstrap resamples, for few runs wider about the value.

    Of B < 10 runs its ends are t sqrt(B/(B - 1))/1.96 times as far away, with Student's t of B - 1 degrees of
    freedom: resamples alone would contain the right mean in 49 % of cases for two runs, 84 % for five.

    Args:
        value: of all runs.
        resampled: values of resamples.
        runs: B.
        is_ratio: whether "far" is a factor, of a positive value such as an RMSE.

    Source: Hesterberg (2015), "What teachers should know about the bootstrap", The American Statistician 69(4).
    """
    ends = np.quantile(resampled, [0.025, 0.975])
    if 1 < runs < FEW_RUNS and isfinite(value) and (value > 0.0 or not is_ratio):
        wider = stdtrit(runs - 1, 0.975) / 1.96 * np.sqrt(runs / (runs - 1))
        ends = value * (ends / value) ** wider if is_ratio else value + wider * (ends - value)
    return Interval(float(value), *ends.tolist())


def without_interval(value: float) -> Interval:
    """A value without its interval, which takes longer to compute than the value."""
    return Interval(float(value), np.nan, np.nan)


def mean_interval(
    values: np.ndarray, resample: bool = True, within: tuple[float, float] = (-np.inf, np.inf)
) -> Interval:
    """Mean of values by run, (B,) or (B, T), with its interval, in limits, if asked for; NaN does not count."""
    values = np.reshape(values, (len(values), -1))
    present = ~np.isnan(values)
    if not present.any():
        return Interval(np.nan, np.nan, np.nan)
    totals, counts = np.where(present, values, 0.0).sum(axis=1), present.sum(axis=1).astype(np.float64)
    value = totals.sum() / counts.sum()
    if not resample:
        return without_interval(value)
    mean = interval(value, ratio_of_resampled(totals, counts), int((counts > 0).sum()))
    return mean._replace(low=max(mean.low, within[0]), high=min(mean.high, within[1]))


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
    return tuple(interval(rmse[i], resampled[:, i], len(mean_squares), is_ratio=True) for i in range(len(rmse)))


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
    return tuple(interval(values[i], ratios[:, i], len(a), is_ratio=True) for i in range(len(values)))


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


SINGULAR = 1e-12  # a pivot of P below this part of its variance counts as zero
LARGEST_BY_ENTRIES = 12  # beyond, operations on single entries take longer than copies of columns
LAGS = 20
BLOW_UP = 1e3  # spreads of a channel: no Q or R explains a prediction that is so far off


def whitened(errors: np.ndarray, covs: np.ndarray) -> np.ndarray:
    """L^-1 e with L L' = P, for errors (..., d) and covariances (..., d, d); NaN where P is singular.

    If the covariances are right, the result has independent components of variance one.
    """
    with np.errstate(over="ignore", invalid="ignore"):  # of a filter that has diverged: NaN
        if errors.shape[-1] <= LARGEST_BY_ENTRIES:
            return _whiten_by_entries(errors, covs)
        if errors.ndim > 2:
            return _whiten_by_runs(errors, covs)
        return _whiten_by_columns(errors, covs)


def _whiten_by_runs(errors: np.ndarray, covs: np.ndarray) -> np.ndarray:
    """`whitened` run by run, on all cores: NumPy lets other threads run meanwhile."""
    out = np.empty(errors.shape)

    def part(first: int, last: int) -> None:
        for run in range(first, last):
            out[run] = whitened(errors[run], covs[run])

    spread(part, len(errors))
    return out


def _whiten_by_entries(errors: np.ndarray, covs: np.ndarray) -> np.ndarray:
    d = errors.shape[-1]
    root: dict[tuple[int, int], np.ndarray] = {}
    solved: list[np.ndarray] = []
    regular = np.ones(errors.shape[:-1], dtype=bool)
    for i in range(d):  # Cholesky factor and forward substitution, each entry an array over all covariances
        for j in range(i):
            rest = sum(root[i, k] * root[j, k] for k in range(j))
            root[i, j] = (covs[..., i, j] - rest) / root[j, j]
        pivot = covs[..., i, i] - sum(root[i, k] ** 2 for k in range(i))
        regular &= pivot > SINGULAR * covs[..., i, i]
        root[i, i] = np.sqrt(np.where(regular, pivot, 1.0))
        solved.append((errors[..., i] - sum(root[i, k] * solved[k] for k in range(i))) / root[i, i])
    return np.where(regular[..., None], np.stack(solved, axis=-1), np.nan)


def _whiten_by_columns(errors: np.ndarray, covs: np.ndarray) -> np.ndarray:
    root, solved = np.zeros(covs.shape), np.empty(errors.shape)
    regular = np.ones(errors.shape[:-1], dtype=bool)
    for j in range(errors.shape[-1]):
        before = root[..., j, :j, None]
        column = covs[..., j:, j] - (root[..., j:, :j] @ before)[..., 0]
        regular &= column[..., 0] > SINGULAR * covs[..., j, j]
        pivot = np.sqrt(np.where(regular, column[..., 0], 1.0))
        root[..., j:, j] = column / pivot[..., None]
        root[..., j, j] = pivot
        solved[..., j] = (errors[..., j] - (solved[..., None, :j] @ before)[..., 0, 0]) / pivot
    return np.where(regular[..., None], solved, np.nan)


def normalized_squares(errors: np.ndarray, covs: np.ndarray) -> np.ndarray:
    """E' P^-1 e for errors (..., d) and covariances (..., d, d); NaN where P is singular.

    With estimation errors this is the NEES, with innovations and their covariances the NIS; for a
    consistent filter each is chi-squared with d degrees of freedom. Source: Bar-Shalom, Li, Kirubarajan (2001),
    Estimation with Applications to Tracking and Navigation, section 5.4.
    """
    return sums_of_squares(whitened(errors, covs))


def sums_of_squares(values: np.ndarray) -> np.ndarray:
    """Sums of squares over the last axis, infinite where they are too large."""
    with np.errstate(over="ignore"):
        return (values**2).sum(axis=-1)


class SquaresCheck(NamedTuple):
    """NEES or NIS of B runs over T steps, against chi-square."""

    name: str  # "NEES" or "NIS"
    dimension: float  # the right mean: number of states, or of channels that were there
    mean: Interval  # over runs and steps
    step_means: np.ndarray  # (T,), over runs
    band: np.ndarray  # (T, 2), where the mean over runs lies with 95 % probability in each step
    share_inside: float  # of steps inside their band; 0.95 is right
    beyond: Interval  # share of single values above the 95 % point of chi-square; 0.05 is right
    distribution: Uniformity  # of the values' probabilities under chi-square


def check_whitened(name: str, errors: np.ndarray, present: np.ndarray | None = None) -> SquaresCheck:
    """Compare normalised squares of B independent runs with the chi-square distribution.

    The sum over runs of one step is chi-squared with as many degrees of freedom as there are components, so its
    band is exact even where measurements are missing. Intervals and the test of the distribution resample whole
    runs: values of neighbouring steps are correlated.

    Args:
        name: "NEES" or "NIS", for reports.
        errors: estimation errors or innovations, `whitened`, (B, T, d).
        present: which components are present, (B, T, d); all if None.
    """
    squares = sums_of_squares(errors)
    freedom = np.full(squares.shape, float(errors.shape[-1])) if present is None else present.sum(axis=-1) * 1.0
    freedom = np.where(np.isnan(squares), 0.0, freedom)
    counted = freedom > 0
    squares = np.where(counted, squares, np.nan)
    runs = counted.sum(axis=0)
    any_run, band = runs > 0, band_of_means(freedom)
    means = np.where(any_run, np.nansum(squares, axis=0) / np.maximum(runs, 1), np.nan)
    inside = (means >= band[:, 0]) & (means <= band[:, 1])
    probability = np.where(counted, chdtr(np.maximum(freedom, 1.0), squares), np.nan)
    return SquaresCheck(
        name,
        float(freedom.sum() / counted.sum()) if counted.any() else np.nan,
        mean_interval(squares, within=POSITIVE),
        means,
        band,
        float(inside[any_run].mean()) if any_run.any() else np.nan,
        mean_interval(np.where(counted, probability > 0.95, np.nan), within=SHARE),
        uniformity(probability),
    )


def band_of_means(freedom: np.ndarray) -> np.ndarray:
    """The band (T, 2) in which the mean over runs of a chi-square lies with 95 % probability; NaN without runs.

    The sum over independent runs is chi-squared with the sum of their degrees of freedom.

    Args:
        freedom: degrees of freedom of each run and step, (B, T); 0 where a run does not count.
    """
    runs, total = (freedom > 0).sum(axis=0), freedom.sum(axis=0)
    sums, inverse = np.unique(total, return_inverse=True)  # there are few, and chdtri is slow
    limits = chdtri(np.maximum(sums, 1.0)[:, None], [0.975, 0.025])[inverse]  # it takes the upper tail
    return np.where(runs[:, None] > 0, limits / np.maximum(runs, 1)[:, None], np.nan)


class Whiteness(NamedTuple):
    """Correlations of normalised innovations over time, pooled over runs; all zero for a consistent filter."""

    correlations: np.ndarray  # (lags, m, m): of channel i with channel j so many steps later; lags 1, 2, ...
    half_widths: np.ndarray  # (lags, m, m): a correlation lies within plus and minus this with 95 % probability
    share_inside: float  # of correlations within these; 0.95 is right
    statistic: float  # of the portmanteau test, chi-squared with lags m^2 degrees of freedom; 0 of no values
    p_value: float  # probability of a statistic as large if the innovations were white; NaN of no values


def whiteness(
    innovations: np.ndarray, covs: np.ndarray, present: np.ndarray | None = None, lags: int = LAGS
) -> Whiteness:
    """`whiteness_of` innovations (B, T, m) with their covariances (B, T, m, m)."""
    return whiteness_of(whitened(innovations, covs), present, lags)


def whiteness_of(e: np.ndarray, present: np.ndarray | None = None, lags: int = LAGS) -> Whiteness:
    """Test whether the innovations of B runs are white, with e = L^-1 v and L L' = S.

        rho_ij(l) = sum e_i(k) e_j(k + l) / (c sqrt(mean e_i^2 mean e_j^2)) over all runs and the c pairs of steps
                    that have both
        portmanteau: N sum over l, i, j of c rho_ij(l)^2 (N + 2)/N^2, chi-squared with lags m^2 degrees of freedom

    for N values a channel: with one run and one channel the test of Ljung and Box. Innovations have mean zero,
    so none is subtracted. Many runs find correlations that are too small to matter: look at their size, too.

    Args:
        e: whitened innovations, (B, T, m), as `filters.consistency.nees.whitened` gives them.
        present: which channels were measured, (B, T, m); all if None.
        lags: number of lags, less than T.

    Raises:
        ValueError: if there are not more steps than lags.

    Source: Ljung, Box (1978), "On a measure of lack of fit in time series models"; Hosking (1980), "The
    multivariate portmanteau statistic"; Bar-Shalom, Li, Kirubarajan (2001), section 5.4.
    """
    steps = e.shape[1]
    lags = at_least("lags", lags, 1)
    if steps <= lags:
        raise ValueError(f"there must be more steps than lags, but got {steps} steps and {lags} lags")
    mask = ~np.isnan(e) if present is None else present & ~np.isnan(e)
    e, mask = np.where(mask, e, 0.0), mask.astype(np.float64)
    values = np.maximum(mask.sum(axis=(0, 1)), 1.0)
    e /= np.sqrt(np.maximum((e**2).sum(axis=(0, 1)) / values, 1e-300))
    sums = _lagged_sums(e, lags)
    pairs = _all_pairs(mask, lags) if mask.all() else _lagged_sums(mask, lags)
    known = pairs > 0  # a channel without measurements does not count as white
    pairs = np.maximum(pairs, 1.0)
    correlations = sums / pairs
    size = np.sqrt(np.outer(values, values))
    squares = correlations**2 * pairs * (size + 2.0) / size  # each chi-squared with one degree of freedom
    statistic = float(squares.sum())
    return Whiteness(
        correlations,
        1.96 * np.sqrt(size / (size + 2.0) / pairs),
        float((squares[known] <= 1.96**2).mean()) if known.any() else np.nan,
        statistic,
        float(chdtrc(known.sum(), statistic)) if known.any() else np.nan,
    )


def _lagged_sums(x: np.ndarray, lags: int) -> np.ndarray:
    """Sums over runs and steps k of x_i(k) x_j(k + l), (lags, m, m), for x of shape (B, T, m) and l from 1 on."""
    path = ["einsum_path", (0, 1)]  # the only one, which to find took half of the time
    return np.array(
        [np.einsum("bki,bkj->ij", x[:, :-lag], x[:, lag:], optimize=path) for lag in range(1, lags + 1)]
    )


def _all_pairs(mask: np.ndarray, lags: int) -> np.ndarray:
    runs, steps, m = mask.shape
    return np.broadcast_to(runs * (steps - np.arange(1.0, lags + 1.0))[:, None, None], (lags, m, m))


def root_mean_square(values: np.ndarray) -> float:
    """Root mean square of the values that are not NaN, infinite only if one of them is; NaN of none."""
    present = values[~np.isnan(values)]
    if not present.size:
        return np.nan
    largest = float(abs(present).max()) or 1.0  # by which squares stay finite where a model blows up
    return float(np.sqrt(((present / largest) ** 2).mean()) * largest) if isfinite(largest) else np.inf


def blow_up_sentence(
    innovations: np.ndarray, measurements: np.ndarray, names: Sequence[str], dt: float | None = None
) -> str:
    """A sentence on a model that blows up between samples; empty if it does not.

    It blows up if a channel's root mean square innovation is a thousand times the channel's standard deviation.

    Args:
        innovations: (..., m), NaN where they do not count.
        measurements: (..., m), NaN where missing.
        names: of the channels.
        dt: sample time [s], if there is one.
    """
    for j, name in enumerate(names):
        rmse, z = root_mean_square(innovations[..., j]), measurements[..., j]
        if np.isnan(rmse) or np.isnan(z).all():
            continue
        spread = float(np.nanstd(z))
        if rmse > BLOW_UP * spread:
            time = "this dt" if dt is None else f"dt = {dt:g} s"
            return (
                f"The model diverges between samples: its prediction of {name} is off by {rmse:.3g}, and "
                f"{spread:.3g} is the channel's standard deviation. Its integration step is too long for "
                f"{time}: give the model more substeps or the data a smaller dt, and check that the "
                "model's time is in seconds, as that of the data is."
            )
    return ""
