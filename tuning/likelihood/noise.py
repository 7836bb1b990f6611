"""Q or R as a function of tuned parameters, with exact derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from tuning.search.correlations import correlation_slopes, correlations_of, full_covariance
from tuning.search.parameters import CORRELATIONS, Correlation, MeasurementVariance, ProcessVariance


class TunedCovariance:
    """A covariance (n, n), of which some variances and correlations are tuned.

    Where no correlation is tuned, a variance scales its row and column: C = D C_0 D, with D the roots of what the
    variances have grown by. Else C is the `full_covariance` of both.

    Args:
        base: the covariance before.
        name: of the covariance, as places of correlations have it.
        variance: the kind of places that its variances are.
        moved: of each of p parameters the places that it sets, and by which factors.
    """

    def __init__(
        self,
        base: np.ndarray,
        name: str,
        variance: type[ProcessVariance | MeasurementVariance],
        moved: Sequence[Sequence[tuple[Any, float]]],
    ):
        """Find the parameters of this covariance."""
        self._base, self._count = base, len(moved)
        all_places: list[tuple[int, Any, float]] = [
            (i, place, factor) for i, places in enumerate(moved) for place, factor in places
        ]
        self._variances = [(i, one.index, by) for i, one, by in all_places if isinstance(one, variance)]
        self._correlations = [
            (i, one.index, by)
            for i, one, by in all_places
            if isinstance(one, Correlation) and one.covariance == name
        ]

    def at(self, values: np.ndarray, units: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The covariance and its derivatives (p, n, n) by coordinates, for values and units of all parameters."""
        n = len(self._base)
        variances = np.diag(self._base).copy()
        for i, at, factor in self._variances:
            variances[at] = factor * values[i]
        slopes = np.zeros((self._count, n, n))
        if self._correlations:
            given = np.clip(correlations_of(self._base), *CORRELATIONS)
            for i, k, factor in self._correlations:
                given[k] = factor * values[i]
            cov = full_covariance(variances.tolist(), given.tolist())
            by_correlations = correlation_slopes(variances.tolist(), given.tolist())
            for i, k, factor in self._correlations:
                slopes[i] += factor * units[i] * by_correlations[k]
        else:
            grown = np.sqrt(variances / np.where(np.diag(self._base) > 0, np.diag(self._base), 1.0))
            cov = self._base * np.outer(grown, grown)
            cov[range(n), range(n)] = variances
        for i, at, _ in self._variances:  # of logarithms, to which factors do nothing
            slopes[i, at] += 0.5 * cov[at]
            slopes[i, :, at] += 0.5 * cov[at]
        return cov, slopes
