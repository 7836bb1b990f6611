"""Numbers of a column that no normal noise explains, left out of its fit, and jumps, which are named.

A number is far if its innovation is beyond the gate. All innovations of a record of normal noise are within it
with a probability of 99 %. Up to `BURST` far numbers in a row, after which the record returns, are outliers: the
model is fitted without them, and they are found anew with that model until they stay the same. If the record does
not return, it jumps there.

Source: Bar-Shalom, Li, Kirubarajan (2001), Estimation with Applications to Tracking and Navigation, section 3.6,
for gates.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.special import ndtri

from filters.models import named_model
from tuning.series.column import Column, seconds_text
from tuning.series.fit import Candidate, filtered, most_likely
from tuning.series.likelihood import R, model_of
from tuning.series.paste import BURST

if TYPE_CHECKING:
    from tuning.series.answer import SeriesFit

LEVEL = 0.01  # probability that a record of normal noise has a number beyond the gate
MOST = 0.25  # share of the numbers that may be outliers
RETURNED = 0.7  # of an outlier's height, above which the number after it has not returned
ROUNDS = 8  # of leaving out and fitting one model again
OF_MEDIANS = 8.0  # medians of the distance from neighbours, beyond which a number is far from them
SMALL = 0.33  # median of normalised innovations about their median, half of that of normal noise
SETTLING = 500  # rows after which a filter has settled
CHOICES = 2  # of the model again, without outliers
REGULAR = 0.1  # deviation of the times between peaks, in their mean, below which they are signal


class Far(NamedTuple):
    """Numbers far from their prediction.

    Attributes:
        outliers: whether each number is one, (K, axes).
        jumps: rows at which an axis begins to have another course, and innovations there [standard deviations].
        gate: number of standard deviations beyond which a number is far.
    """

    outliers: np.ndarray
    jumps: tuple[tuple[int, float], ...]
    gate: float


def without_outliers(column: Column, fit: Callable[[Column], SeriesFit]) -> SeriesFit:
    """The fit without the outliers, which it names.

    All numbers count if more than `MOST` of them are outliers, if they come at regular times, if they are most of
    a stretch, which then has another variance, or if the others do not vary. If the model does not fit the others,
    it predicts too poorly to tell an outlier from a course that it misses: then only numbers that are also far
    from the median of their neighbours are left out.

    Args:
        column: the numbers.
        fit: chooses and fits a model.
    """
    of_all = fit(column)
    far = far_of_all = far_from(of_all.chosen, of_all.level, column)
    if not (far.outliers.any() or far.jumps or _hides_many(of_all)):
        return of_all
    off_median = far_from_medians(column)
    answer, first = of_all, far.outliers | off_median
    if not first.any():
        return replace(of_all, jumps=far.jumps)
    try:
        for _ in range(CHOICES):
            outliers = _settled(answer.chosen, column, first, off_median)
            answer, far = _fit_without(outliers, column, fit, off_median)
            first = far.outliers
            if (first == outliers).all():
                break
        certain = outliers & off_median
        if answer.is_wrong and certain.any() and not _are_together(off_median):
            outliers = certain
            answer, far = _fit_without(outliers, column, fit, off_median)
        elif answer.is_wrong:
            raise NoOutliersError("without them no model that was tried fits")
        if not outliers.any():
            return replace(of_all, jumps=far_of_all.jumps)
        values = np.where(outliers, column.table, np.nan)
        return replace(answer, left_out=values, gate=far.gate, jumps=far.jumps)
    except NoOutliersError as error:
        reason = str(error)
    except ValueError:  # of the fit
        reason = "without them the others do not vary"
    answer, what = replace(of_all, jumps=far_of_all.jumps), "the prediction"
    if not far_of_all.outliers.any():
        if far.jumps:
            return answer
        what = "their neighbours"
    count = int((far_of_all.outliers if far_of_all.outliers.any() else off_median).sum())
    numbers = "1 number is" if count == 1 else f"{count} numbers are"
    return replace(answer, peaks=f"{numbers} far from {what}, but part of the fit: {reason}.")


def _fit_without(
    outliers: np.ndarray, column: Column, fit: Callable[[Column], SeriesFit], off_median: np.ndarray
) -> tuple[SeriesFit, Far]:
    """The fit without outliers, and what is far from that, unless they are signal."""
    rows = np.flatnonzero(outliers.any(axis=1))
    _check_irregular(rows, column.times[rows])
    if _are_together(outliers):
        raise NoOutliersError("they are most numbers of a stretch, which has another variance")
    answer = fit(column.without(outliers))
    return answer, far_from(answer.chosen, answer.level, column, off_median)


def _hides_many(fit: SeriesFit) -> bool:
    """Whether so many outliers made S so large that none of them is far: then most innovations are small.

    Of normal noise, half of them are within 0.67 standard deviations of their median.
    """
    variances = np.diagonal(fit.estimates.innovation_covs[0], axis1=1, axis2=2)
    normalised = (fit.estimates.innovations[0] / np.sqrt(variances))[fit.column.counted(fit.model)]
    return bool(np.median(np.abs(normalised - np.median(normalised))) < SMALL)


class NoOutliersError(ValueError):
    """Numbers far from their prediction are no outliers, for a reason."""


def _check_irregular(rows: np.ndarray, times: np.ndarray) -> None:
    """Raise NoOutliersError for peaks in rows at regular times [s]."""
    apart = np.diff(times[np.diff(rows, prepend=-2) > 1])  # of bursts, the first of each
    if len(apart) >= 6 and apart.std() < REGULAR * apart.mean():
        raise NoOutliersError(f"they come each {seconds_text(float(apart.mean()))}, so they are signal")


def far_from_medians(column: Column) -> np.ndarray:
    """Numbers far from the median of their neighbours, (K, axes): outliers to begin with, as many hide many."""
    far = np.zeros(column.table.shape, dtype=bool)
    for axis, measured in enumerate(column.measured.T):
        z = column.table[measured, axis]
        windows = sliding_window_view(np.pad(z, BURST, mode="reflect"), 2 * BURST + 1)
        off = np.abs(z - np.median(windows, axis=1))
        scale = float(np.median(off))
        if scale == 0.0 and off.any():  # of rounded numbers that stay: a digit
            scale = float(off[off > 0.0].min())
            off *= (off > OF_MEDIANS * scale).mean() < MOST
        far[measured, axis] = off > OF_MEDIANS * scale
    return far


def _are_together(off: np.ndarray) -> bool:
    """Whether most numbers of a stretch are far from their median."""
    return any(np.convolve(axis, np.ones(4 * BURST)).max() > 2 * BURST for axis in off.T)


def _settled(candidate: Candidate, column: Column, outliers: np.ndarray, off_median: np.ndarray) -> np.ndarray:
    """The outliers of one model, fitted without them again and again until they stay the same, (K, axes).

    It begins without `outliers`, (K, axes); `off_median` are those far from the median of their neighbours.

    Raises:
        NoOutliersError: if more than `MOST` of the numbers are outliers.
    """
    model = named_model(candidate.name)
    for _ in range(ROUNDS):
        if outliers.sum() > MOST * column.measured.sum():
            raise NoOutliersError(f"there are more than {100.0 * MOST:.0f} % of them")
        fitted = most_likely(model, column.without(outliers))
        before, outliers = outliers, far_from(fitted.candidate, fitted.mean, column, off_median).outliers
        if (before == outliers).all():
            break
    return outliers


def far_from(
    candidate: Candidate, level: np.ndarray | None, column: Column, off_median: np.ndarray | None = None
) -> Far:
    """Outliers and jumps of a column under a fitted model; `level` is the mean about which it varies, if any.

    Until the filter has followed a jump, outliers are those far from the median of their neighbours, `off_median`.
    Outliers among the first numbers, from which the filter learns its state, are those of the record backwards:
    all named models are the same in both directions.
    """
    first = len(named_model(candidate.name).signal(_signal_values(candidate)).output) + BURST
    begin, outliers = column.rows(0, SETTLING).backwards, np.zeros(column.table.shape, dtype=bool)
    backwards = _far(candidate, level, begin, outliers[:SETTLING]).outliers[::-1]
    outliers[:first] = backwards[:first]
    return _far(candidate, level, column, outliers, off_median)


def _far(
    candidate: Candidate,
    level: np.ndarray | None,
    column: Column,
    outliers: np.ndarray,
    off_median: np.ndarray | None = None,
) -> Far:
    """`far_from`, with outliers among the first numbers that are known before.

    Each pass filters without the outliers known so far, and takes the first far number of each group, since those
    behind it may be far because of it. A group after which the record stays where it went is a jump.
    """
    named, values = named_model(candidate.name), candidate.values
    model = model_of(named, column, values, level)
    signal = named.signal(_signal_values(candidate))
    counted = column.counted(model)
    gate = math.ceil(-10.0 * float(ndtri(0.5 * LEVEL / max(counted.sum(), 1)))) / 10.0
    settled, heights, relative = outliers.copy(), np.zeros(counted.shape), np.zeros(counted.shape)
    outliers = outliers.copy()
    jumps = list[tuple[int, float]]()
    for _ in range(4 * BURST):
        estimates = filtered(signal, model, column.without(outliers))
        innovations = estimates.innovations[0]
        deviations = np.sqrt(np.diagonal(estimates.innovation_covs[0], axis1=1, axis2=2))
        far = (np.abs(innovations) > gate * deviations) & counted & ~outliers & ~settled
        for axis in range(far.shape[1]):
            for begin, end in _bursts(outliers[:, axis], column.measured[:, axis]):
                if settled[begin, axis]:
                    continue
                height, next_far = heights[begin, axis], end < len(far) and far[end, axis]
                stays = end < len(far) and not next_far and innovations[end, axis] / height > RETURNED
                if stays or outliers[begin:end, axis].sum() > BURST:
                    settled[begin : end + BURST, axis], far[begin : end + BURST, axis] = True, False
                    while end < len(far) and (settled[end, axis] or outliers[end, axis]):
                        end += 1  # what was far after it was so because of it
                    outliers[begin:end, axis] = False
                    if off_median is not None:
                        after = column.table[begin:end, axis]
                        apart = np.abs(after - np.nanmedian(after)) > 0.5 * abs(height)
                        outliers[begin:end, axis] = off_median[begin:end, axis] & apart
                    jumps.append((begin, float(relative[begin, axis])))
            rows = np.flatnonzero(far[:, axis])
            order = np.cumsum(column.measured[:, axis])[rows]
            alone = np.diff(order, prepend=-2 * BURST) > BURST  # those after it may be far because of it
            rows = rows[alone if off_median is None else alone | off_median[rows, axis]]
            outliers[rows, axis], heights[rows, axis] = True, innovations[rows, axis]
            relative[rows, axis] = innovations[rows, axis] / deviations[rows, axis]
            far[:, axis] = False
            far[rows, axis] = True
        if not far.any():
            break
    return Far(outliers, tuple(sorted(jumps)), gate)


def _signal_values(candidate: Candidate) -> dict[str, float]:
    return {name: value for name, value in candidate.values.items() if name != R}


def _bursts(outliers: np.ndarray, measured: np.ndarray) -> list[tuple[int, int]]:
    """The first row of each run of outliers, and the first measured row after it, or the number of rows."""
    rows = np.flatnonzero(measured)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], outliers[rows], [False]])))
    after = np.append(rows, len(measured))
    return [(int(rows[begin]), int(after[end])) for begin, end in zip(edges[::2], edges[1::2], strict=True)]
