"""Q or R as a function of tuned parameters, with exact derivatives."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tuning.problems.parameter import Place
from tuning.search.correlations import correlation_slopes, correlations_of, full_covariance
from tuning.search.parameters import CORRELATIONS, Correlation


class TunedCovariance:
    """A covariance (n, n), of which some variances and correlations are tuned.

    Where no correlation is tuned, a variance scales its row and column: C = D C_0 D, with D the roots of what the
    variances have grown by. Else C is the `full_covariance` of both.

    Args:
        base: the covariance before.
        name: of the covariance, as places of correlations have it.
        variances: of each of p parameters the index of the variance that it is, or None.
        places: of the p parameters.
    """

    def __init__(self, base: np.ndarray, name: str, variances: Sequence[int | None], places: Sequence[Place]):
        """Find the parameters of this covariance."""
        self._base = base
        self._variances = {i: at for i, at in enumerate(variances) if at is not None}
        self._correlations = {
            i: one.index for i, one in enumerate(places) if isinstance(one, Correlation) and one.covariance == name
        }
        self._count = len(places)

    def at(self, values: np.ndarray, units: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The covariance and its derivatives (p, n, n) by coordinates, for values and units of all parameters."""
        n = len(self._base)
        variances = np.diag(self._base).copy()
        variances[list(self._variances.values())] = values[list(self._variances)]
        slopes = np.zeros((self._count, n, n))
        if self._correlations:
            given = np.clip(correlations_of(self._base), *CORRELATIONS)
            given[list(self._correlations.values())] = values[list(self._correlations)]
            cov = full_covariance(variances.tolist(), given.tolist())
            by_correlations = correlation_slopes(variances.tolist(), given.tolist())
            for i, k in self._correlations.items():
                slopes[i] = units[i] * by_correlations[k]
        else:
            grown = np.sqrt(variances / np.where(np.diag(self._base) > 0, np.diag(self._base), 1.0))
            cov = self._base * np.outer(grown, grown)
            cov[range(n), range(n)] = variances
        for i, at in self._variances.items():
            slopes[i, at] += 0.5 * cov[at]
            slopes[i, :, at] += 0.5 * cov[at]
        return cov, slopes
