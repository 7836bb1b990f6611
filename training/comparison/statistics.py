"""Interquartile means over training seeds, and their bootstrap over episodes and training seeds.

A figure is an array of 1 + RESAMPLES values: the estimate, then the same from resampled data. So differences and
ratios of figures are figures. Episodes are the same for all policies and are drawn jointly.

The interquartile mean is less at the mercy of one bad seed than the mean, and wastes less than the median. Source:
R. Agarwal, M. Schwarzer, P. S. Castro, A. Courville, M. Bellemare (2021), "Deep reinforcement learning at the edge
of the statistical precipice", NeurIPS 34.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from scipy.stats import trim_mean

from filters.consistency.intervals import RESAMPLES, Interval, interval, resampled_means
from training.comparison.runs import Result


def typical_return(results: Sequence[Result]) -> np.ndarray:
    """Interquartile mean over seeds of the mean return of one policy, as a figure."""
    return _over_seeds(_over_episodes(np.stack([result.scores.returns for result in results], axis=1)))


def typical_error(results: Sequence[Result], part: str) -> np.ndarray:
    """Interquartile mean over seeds of the pooled thrust error in a part of `Scores`, RMS [N], as a figure.

    NaN where no step counts.
    """
    parts = [getattr(result.scores, part) for result in results]
    squares, steps = (np.stack(columns, axis=1) for columns in zip(*parts, strict=True))
    with np.errstate(invalid="ignore"):
        return _over_seeds(np.sqrt(_over_episodes(squares) / _over_episodes(steps)))


def as_interval(figure: np.ndarray) -> Interval:
    """The estimate with its 95 % interval."""
    return interval(figure[0], figure[1:])


def interquartile_mean(values: np.ndarray, axis: int = 0) -> np.ndarray:
    """Mean of the middle half of values along an axis; of all of them if they are fewer than four."""
    return trim_mean(values, 0.25, axis=axis)


def _over_episodes(values: np.ndarray) -> np.ndarray:
    """Means over episodes of values (episodes, seeds), then those of resamples; (1 + RESAMPLES, seeds)."""
    return np.concatenate([values.mean(axis=0)[None], resampled_means(values)])


def _over_seeds(values: np.ndarray) -> np.ndarray:
    """Interquartile mean of each row of values (1 + RESAMPLES, seeds); of drawn seeds but in the first."""
    return interquartile_mean(np.take_along_axis(values, _drawn_seeds(values.shape[1]), axis=1), axis=1)


@lru_cache(maxsize=8)
def _drawn_seeds(count: int) -> np.ndarray:
    drawn = np.random.default_rng(1).integers(count, size=(RESAMPLES, count))
    return np.concatenate([np.arange(count)[None], drawn])
