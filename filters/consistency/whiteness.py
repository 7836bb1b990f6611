"""Do innovations contain anything that the filter could have predicted? Their correlation over time."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import chdtrc

from filters.consistency.nees import whitened
from thruster_env.core.checks import at_least

LAGS = 20


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
    there = ~np.isnan(e) if present is None else present & ~np.isnan(e)
    e, there = np.where(there, e, 0.0), there.astype(np.float64)
    values = np.maximum(there.sum(axis=(0, 1)), 1.0)
    e /= np.sqrt(np.maximum((e**2).sum(axis=(0, 1)) / values, 1e-300))
    sums = _lagged_sums(e, lags)
    pairs = _all_pairs(there, lags) if there.all() else _lagged_sums(there, lags)
    known = pairs > 0  # a channel that never was measured is no white one
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


def _all_pairs(there: np.ndarray, lags: int) -> np.ndarray:
    """The same of ones: numbers of pairs."""
    runs, steps, m = there.shape
    return np.broadcast_to(runs * (steps - np.arange(1.0, lags + 1.0))[:, None, None], (lags, m, m))
