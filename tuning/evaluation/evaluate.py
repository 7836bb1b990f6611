"""A filter on a scenario: errors with intervals, consistency, and paired comparisons."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from filters.consistency.intervals import Interval, interval, mean_interval, resampled_means, rmse_intervals
from filters.consistency.nees import normalized_squares
from filters.consistency.report import ConsistencyReport, consistency_report
from filters.engine.batch import Estimates, run
from filters.ensembles.recording import record_members
from filters.filter import Filter
from thruster_env.model import thrusts_of
from tuning.problems.data import FIRST_SCORED_STEP, Data

STATES = ("omega_m [rad/s]", "U_a [m/s]")
MEMBER_RUNS, MEMBER_STEPS = 40, 5  # rank histograms are made of so many runs, and of every fifth step


class Evaluation(NamedTuple):
    """What a filter achieved on B seeds; errors are pooled over seeds and over the steps that count."""

    rmse: tuple[Interval, ...]  # by state, (omega_m [rad/s], U_a [m/s])
    start_up_rmse: np.ndarray  # (n,), over the steps before 50
    score: Interval  # mean over states of RMSE over scale [-]
    thrust_rmse: Interval  # of the thrust that the filter's model has at its estimate [N]
    nees: Interval  # mean; n is right; NaN for filters that give no covariance
    median_nees: float  # for two states 1.39 is right; says more where a few steps have all of the mean
    nis: Interval  # mean; m is right
    channels: int  # m
    log_likelihood: float  # mean over seeds of the scored steps' sum; NaN for filters that give no covariance
    divergences: int  # restarts from the prior, over all seeds
    mean_squares: np.ndarray  # (B, n), mean square error of each run, for paired comparisons
    scale: np.ndarray  # (n,), what the score measures errors in


def evaluate(filter_: Filter, data: Data, scale) -> Evaluation:
    """Run a filter over all seeds of some data in one compiled, parallel call, and judge it.

    Args:
        filter_: the filter; where it estimates more than the plant's n states, these come first.
        data: truth, inputs and measurements of a scenario.
        scale: (n,) what errors are measured in for the score, as the scenario says.

    Raises:
        ValueError: if the scale is not positive.
    """
    return judge(filter_, run(filter_, data.filter_keys, data.inputs, data.measurements), data, scale)


def judge(filter_: Filter, estimates: Estimates, data: Data, scale) -> Evaluation:
    """What the estimates of a filter on some data are worth; arguments and errors are those of `evaluate`."""
    scale = np.asarray(scale, dtype=np.float64)
    if not (scale > 0).all():
        raise ValueError(f"scale must be positive in every state, but got {scale.tolist()}")
    n, late = data.states.shape[-1], data.scored
    errors = estimates.means[..., :n] - data.states
    squares = normalized_squares(errors[:, late], estimates.covs[:, late, :n, :n])
    mean_squares = (errors[:, late] ** 2).mean(axis=1)
    with np.errstate(all="ignore"):  # estimates far off, though finite, may have a thrust that is not
        thrusts = np.clip(thrusts_of(filter_.model, estimates.means[:, late]), -1e100, 1e100)
    thrust_errors = thrusts - data.outputs["T"][:, late]
    innovations, innovation_covs = estimates.innovations[:, late], estimates.innovation_covs[:, late]
    measured = ~np.isnan(data.measurements[:, late]).all(axis=-1)
    nis = np.where(measured, normalized_squares(innovations, innovation_covs), np.nan)
    likelihood = estimates.log_likelihoods[:, late] if filter_.has_covariance else np.full((1, 1), np.nan)
    resampled = np.sqrt(resampled_means(mean_squares))  # (resamples, n)
    return Evaluation(
        rmse=rmse_intervals(mean_squares),
        start_up_rmse=np.sqrt((errors[:, :FIRST_SCORED_STEP] ** 2).mean(axis=(0, 1))),
        score=interval(score(mean_squares, scale), (resampled / scale).mean(axis=1)),
        thrust_rmse=rmse_intervals((thrust_errors**2).mean(axis=1, keepdims=True))[0],
        nees=mean_interval(squares),
        median_nees=float(np.nanmedian(squares)) if np.isfinite(squares).any() else np.nan,
        nis=mean_interval(nis),
        channels=data.measurements.shape[-1],
        log_likelihood=float(likelihood.sum(axis=1).mean()),
        divergences=int(estimates.divergences.sum()),
        mean_squares=mean_squares,
        scale=scale,
    )


def check_consistency(filter_: Filter, data: Data) -> ConsistencyReport:
    """Whether a filter's covariance is honest on a scenario, and for an ensemble whether its members are."""
    estimates = run(filter_, data.filter_keys, data.inputs, data.measurements)
    members = None
    if filter_.size:
        some = (part[:MEMBER_RUNS] for part in (data.filter_keys, data.inputs, data.measurements))
        members = record_members(filter_, *some, first=data.scored.start, every=MEMBER_STEPS)
    return consistency_report(
        estimates,
        data.states,
        data.measurements,
        members=members,
        first_step=data.scored.start,
        names=STATES,
    )


def score(mean_squares: np.ndarray, scale: np.ndarray) -> float:
    """Mean over states of RMSE over scale, from mean square errors of runs (B, n)."""
    return float((np.sqrt(mean_squares.mean(axis=0)) / scale).mean())


def run_scores(estimates: Estimates, data: Data, scale) -> np.ndarray:
    """The score of each run by itself, (B,): mean over states of its RMSE over scale."""
    late = data.scored
    errors = estimates.means[:, late, : data.states.shape[-1]] - data.states[:, late]
    return (np.sqrt((errors**2).mean(axis=1)) / np.asarray(scale)).mean(axis=1)


def score_ratio(a: Evaluation, b: Evaluation) -> Interval:
    """Score of a over score of b on the same seeds, with a paired bootstrap interval over seeds.

    Raises:
        ValueError: if the two were not evaluated on equally many seeds.
    """
    if a.mean_squares.shape != b.mean_squares.shape:
        raise ValueError(
            f"a paired comparison needs the same seeds, but got {len(a.mean_squares)} and {len(b.mean_squares)}"
        )
    scores = [(np.sqrt(resampled_means(e.mean_squares)) / e.scale).mean(axis=1) for e in (a, b)]
    return interval(score(a.mean_squares, a.scale) / score(b.mean_squares, b.scale), scores[0] / scores[1])
