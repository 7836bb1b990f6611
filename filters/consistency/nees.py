"""Is a filter's covariance consistent? NEES and NIS of many runs against their chi-square distributions.

NEES is the normalised estimation error squared, e' P^-1 e; NIS is the normalised innovation squared, v' S^-1 v.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import chdtr, chdtri

from filters.consistency.intervals import Interval, mean_interval
from filters.consistency.uniformity import Uniformity, uniformity
from thruster_env.core.threads import spread

SINGULAR = 1e-12  # a pivot of P below this part of its variance counts as zero
LARGEST_BY_ENTRIES = 12  # beyond, operations on single entries take longer than copies of columns


def whitened(errors: np.ndarray, covs: np.ndarray) -> np.ndarray:
    """L^-1 e with L L' = P, for errors (..., d) and covariances (..., d, d); NaN where P is singular.

    If the covariances are right, the result has independent components of variance one.
    """
    with np.errstate(over="ignore", invalid="ignore"):  # of a filter that has diverged: NaN
        if errors.shape[-1] <= LARGEST_BY_ENTRIES:
            return _by_entries(errors, covs)
        if errors.ndim > 2:
            return _by_runs(errors, covs)
        return _by_columns(errors, covs)


def _by_runs(errors: np.ndarray, covs: np.ndarray) -> np.ndarray:
    """`whitened` of one run after the other, shared out to the cores: NumPy lets other threads run meanwhile."""
    out = np.empty(errors.shape)

    def part(first: int, last: int) -> None:
        for run in range(first, last):
            out[run] = whitened(errors[run], covs[run])

    spread(part, len(errors))
    return out


def _by_entries(errors: np.ndarray, covs: np.ndarray) -> np.ndarray:
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


def _by_columns(errors: np.ndarray, covs: np.ndarray) -> np.ndarray:
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
    some, band = runs > 0, band_of_means(freedom)
    means = np.where(some, np.nansum(squares, axis=0) / np.maximum(runs, 1), np.nan)
    inside = (means >= band[:, 0]) & (means <= band[:, 1])
    probability = np.where(counted, chdtr(np.maximum(freedom, 1.0), squares), np.nan)
    return SquaresCheck(
        name,
        float(freedom.sum() / counted.sum()) if counted.any() else np.nan,
        mean_interval(squares),
        means,
        band,
        float(inside[some].mean()) if some.any() else np.nan,
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
    sums, place = np.unique(total, return_inverse=True)  # there are few, and chdtri is slow
    limits = chdtri(np.maximum(sums, 1.0)[:, None], [0.975, 0.025])[place]  # it takes the upper tail
    return np.where(runs[:, None] > 0, limits / np.maximum(runs, 1)[:, None], np.nan)
