"""A filter on a scenario: errors with intervals, consistency, and paired comparisons."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from filters.batch import run
from filters.consistency import normalized_squares
from filters.filter import Filter
from tuning.scenarios import FIRST_SCORED_STEP, Data

RESAMPLES = 2000  # bootstrap resamples of whole runs


class Interval(NamedTuple):
    """An estimate with its 95 % interval."""

    value: float
    low: float
    high: float


class Evaluation(NamedTuple):
    """What a filter achieved on B seeds; errors are pooled over seeds and over steps from 50 on."""

    rmse: tuple[Interval, ...]  # by state, (omega_m [rad/s], U_a [m/s])
    start_up_rmse: np.ndarray  # (n,), over the steps before 50
    score: Interval  # mean over states of RMSE over scale [-]
    nees: Interval  # mean; n is right
    nis: Interval  # mean; m is right
    log_likelihood: float  # mean over seeds of the scored steps' sum
    divergences: int  # restarts from the prior, over all seeds
    mean_squares: np.ndarray  # (B, n), mean square error of each run, for paired comparisons
    scale: np.ndarray  # (n,), what the score measures errors in


def evaluate(filter_: Filter, data: Data, scale) -> Evaluation:
    """Run a filter over all seeds of some data in one compiled, parallel call, and judge it.

    Args:
        filter_: the filter.
        data: truth, inputs and measurements of a scenario.
        scale: (n,) what errors are measured in for the score, as the scenario says.

    Raises:
        ValueError: if the scale is not positive.
    """
    scale = np.asarray(scale, dtype=np.float64)
    if not (scale > 0).all():
        raise ValueError(f"scale must be positive in every state, but got {scale.tolist()}")
    estimates = run(filter_, data.filter_keys, data.inputs, data.measurements)
    errors = estimates.means - data.states
    late = slice(FIRST_SCORED_STEP, None)
    mean_squares = (errors[:, late] ** 2).mean(axis=1)
    nees = np.nanmean(normalized_squares(errors[:, late], estimates.covs[:, late]), axis=1)
    nis = np.nanmean(
        normalized_squares(estimates.innovations[:, late], estimates.innovation_covs[:, late]), axis=1
    )
    resampled = np.sqrt(_resampled_means(mean_squares))  # (resamples, n)
    rmse = np.sqrt(mean_squares.mean(axis=0))
    return Evaluation(
        rmse=tuple(interval(rmse[i], resampled[:, i]) for i in range(len(rmse))),
        start_up_rmse=np.sqrt((errors[:, :FIRST_SCORED_STEP] ** 2).mean(axis=(0, 1))),
        score=interval(score(mean_squares, scale), (resampled / scale).mean(axis=1)),
        nees=mean_interval(nees),
        nis=mean_interval(nis),
        log_likelihood=float(estimates.log_likelihoods[:, late].sum(axis=1).mean()),
        divergences=int(estimates.divergences.sum()),
        mean_squares=mean_squares,
        scale=scale,
    )


def score(mean_squares: np.ndarray, scale: np.ndarray) -> float:
    """Mean over states of RMSE over scale, from mean square errors of runs (B, n)."""
    return float((np.sqrt(mean_squares.mean(axis=0)) / scale).mean())


def score_ratio(a: Evaluation, b: Evaluation) -> Interval:
    """Score of a over score of b on the same seeds, with a paired bootstrap interval over seeds.

    Raises:
        ValueError: if the two were not evaluated on equally many seeds.
    """
    if a.mean_squares.shape != b.mean_squares.shape:
        raise ValueError(
            f"a paired comparison needs the same seeds, but got {len(a.mean_squares)} and {len(b.mean_squares)}"
        )
    scores = [(np.sqrt(_resampled_means(e.mean_squares)) / e.scale).mean(axis=1) for e in (a, b)]
    return interval(score(a.mean_squares, a.scale) / score(b.mean_squares, b.scale), scores[0] / scores[1])


def interval(value: float, resampled: np.ndarray) -> Interval:
    """A value with the middle 95 % of its bootstrap resamples."""
    low, high = np.quantile(resampled, [0.025, 0.975])
    return Interval(float(value), float(low), float(high))


def mean_interval(values: np.ndarray) -> Interval:
    """Mean of one number a run, with its bootstrap interval over runs."""
    return interval(values.mean(), _resampled_means(values))


def _resampled_means(values: np.ndarray) -> np.ndarray:
    return _bootstrap_weights(len(values)) @ values


@lru_cache(maxsize=8)
def _bootstrap_weights(count: int) -> np.ndarray:
    # Row r holds how often resample r picks each run, over their number. The same in every call: paired
    # quantities stay paired, and results repeat.
    picks = np.random.default_rng(0).multinomial(count, np.full(count, 1.0 / count), size=RESAMPLES)
    return picks / count
