"""Assessment of a filter's run over a log: its innovations, and its errors against channels it did not see.

NIS is the normalised innovation squared.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from filters.consistency.blow_up import root_mean_square
from filters.consistency.nees import whitened
from filters.consistency.whiteness import LAGS, Whiteness, whiteness_of
from filters.logs.estimate import SKIPPED, LogEstimate
from thruster_env.core.angles import difference
from thruster_env.core.checks import at_least
from thruster_env.logs.columns import STATE
from thruster_env.model.quantities import Quantity


class Residual(NamedTuple):
    """Error of a prediction or an estimate with respect to a channel of the log."""

    quantity: Quantity
    rmse: float  # in the channel's unit
    bias: float  # mean of estimate less channel
    rows: int  # in which there was something to compare


class LogFindings(NamedTuple):
    """Results over the rows that count; NaN without covariance or innovation, or where nothing was measured."""

    first: int  # the first row that counts
    rows: int  # that count, and in which something was measured
    mean_nis: float  # over the number of channels that were there: 1 is right
    nis_band: tuple[float, float]  # in which it lies with 95 % probability if the filter is consistent
    whiteness: Whiteness | None  # None without a covariance, or with fewer rows than lags
    predictions: tuple[Residual, ...]  # one step ahead, by channel
    log_likelihood: float
    references: tuple[Residual, ...]  # by reference channel that the model has


def findings(found: LogEstimate, skip: int | None = None) -> LogFindings:
    """The findings of an estimate of a log.

        mean NIS = sum nu' S^-1 nu / sum m_k,  95 % band: chi^2 of sum m_k degrees of freedom, over these

    Args:
        found: from `filters.logs.estimate.estimate`.
        skip: first rows that do not count; 50, or a quarter of a short log, if None.

    Raises:
        ValueError: if no row is left.

    Source: Bar-Shalom, Li, Kirubarajan (2001), section 5.4 (time-average NIS of one run).
    """
    log, rows = found.log, found.log.steps + 1
    first = at_least("skip", min(SKIPPED, rows // 4) if skip is None else skip, 0, rows - 1)
    innovations, covs = found.innovations[first:], found.innovation_covs[first:]
    present = ~np.isnan(innovations)
    some, count = (~np.isnan(log.measurements[first:])).any(axis=1), int(present.sum())
    nis, band, white = np.nan, (np.nan, np.nan), None
    if found.filter.has_covariance and np.isfinite(covs[present.any(axis=1)]).any():
        e = whitened(np.where(present, innovations, 0.0), covs)
        nis = float((np.where(present, e, 0.0) ** 2).sum() / count)
        band = float(chdtri(count, 0.975) / count), float(chdtri(count, 0.025) / count)
        white = whiteness_of(e[None], present[None]) if len(e) > LAGS else None
    predictions = [_residual(quantity, -innovations[:, j]) for j, quantity in enumerate(log.measured)]
    references = [_residual(log.referred[key], reference_errors(found, key)[first:]) for key in compared(found)]
    return LogFindings(
        first,
        int(some.sum()),
        nis,
        band,
        white,
        tuple(predictions),
        float(found.log_likelihoods[first:].sum()),
        tuple(references),
    )


def compared(found: LogEstimate) -> list[str]:
    """The reference channels of a log that the filter's model has as a state or as an output."""
    states, outputs = {one.symbol for one in found.model.states}, set(found.model.outputs)
    known = {STATE: states}
    return [
        key for key in found.log.references if key.partition(":")[2] in known.get(key.partition(":")[0], outputs)
    ]


def estimated(found: LogEstimate, channel: str) -> tuple[np.ndarray, np.ndarray]:
    """The estimate of a reference channel, (K + 1,), and its standard deviation."""
    kind, _, symbol = channel.partition(":")
    if kind != STATE:
        return found.output(symbol)
    place = [one.symbol for one in found.model.states].index(symbol)
    return found.means[:, place], found.stds[:, place]


def reference_errors(found: LogEstimate, channel: str) -> np.ndarray:
    """Estimate less reference, (K + 1,), angles the short way round; NaN where the reference has no sample."""
    values, reference = estimated(found, channel)[0], found.log.references[channel]
    return difference(values[:, None], reference[:, None], (found.log.referred[channel].angle,))[:, 0]


def _residual(quantity: Quantity, errors: np.ndarray) -> Residual:
    there = errors[~np.isnan(errors)]
    if not there.size:
        return Residual(quantity, np.nan, np.nan, 0)
    largest = float(abs(there).max()) or 1.0  # by which sums stay finite where a model blows up
    return Residual(quantity, root_mean_square(there), float((there / largest).mean() * largest), there.size)
