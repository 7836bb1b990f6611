"""Is a filter's covariance consistent? NEES, NIS, the whiteness of innovations, and models that blow up.

NEES is the normalised estimation error squared, e' P^-1 e, NIS the normalised innovation squared, v' S^-1 v.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite
from typing import NamedTuple

import numpy as np
from scipy.special import chdtr, chdtrc, chdtri

from filters.consistency.intervals import Interval, Uniformity, mean_interval, uniformity
from thruster_env.core.checks import at_least
from thruster_env.core.threads import spread

SINGULAR = 1e-12  # a pivot of P below this part of its variance counts as zero
LARGEST_BY_ENTRIES = 12  # beyond, operations on single entries take longer than copies of columns
LAGS = 20
BLOW_UP = 1e3  # spreads of a channel: no Q or R explains a prediction that is so far off


# NEES and NIS of many runs against their chi-square distributions.


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


def check_squares(
    name: str, errors: np.ndarray, covs: np.ndarray, present: np.ndarray | None = None
) -> SquaresCheck:
    """`check_whitened` of errors with their covariances (B, T, d, d); singular ones are left out."""
    return check_whitened(name, whitened(errors, covs), present)


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
        mean_interval(squares),
        means,
        band,
        float(inside[any_run].mean()) if any_run.any() else np.nan,
        mean_interval(np.where(counted, probability > 0.95, np.nan)),
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


# Do innovations contain anything that the filter could have predicted? Their correlation over time.


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


# Does a model blow up between samples? Then its predictions are off by more than any Q or R explains.


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
