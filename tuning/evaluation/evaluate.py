"""A filter on a problem's data: errors with intervals, consistency, and paired comparisons.

For a consistent filter the mean NEES (normalised estimation error squared) equals the number of states, and the
mean NIS (normalised innovation squared) the number of measured channels.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from filters.consistency.nees import (
    POSITIVE,
    Interval,
    blow_up_sentence,
    interval,
    mean_interval,
    pooled_mean,
    resampled_means,
    rmse_intervals,
    without_interval,
)
from filters.consistency.report import ConsistencyReport, findings, joined, report_of
from filters.consistency.time_constants import TimeConstants
from filters.engine.batch import Estimates
from filters.ensembles.square_root import record_members
from filters.filter import Filter
from filters.starts import Restarts, restarts_of
from thruster_env.model.quantities import Quantity
from thruster_env.model.turns import errors_of, innovations_of, readings, tangent_of
from tuning.evaluation.runs import RunMetrics, metrics_of_all, outputs_of
from tuning.problems.data import Data, estimates_in_parts

if TYPE_CHECKING:
    from tuning.evaluation.residuals import UnevenNis

MEMBER_RUNS, MEMBER_STEPS = 40, 5  # runs and step interval of rank histograms
NOTHING = Interval(np.nan, np.nan, np.nan)
BLOW_UP_RUNS = 20  # that tell whether a model blows up
FARTHEST_NEES = 3.0  # factor on the expected mean NEES, beyond which a headline says so


class Evaluation(NamedTuple):
    """Metrics of a filter on B seeds; errors are pooled over seeds and scored steps.

    Without truth, errors, score and NEES are NaN; metrics of the innovations remain.
    """

    states: tuple[Quantity, ...]  # of the plant
    outputs: Mapping[str, Quantity]  # derived, by symbol
    rmse: tuple[Interval, ...]  # by state, in its unit
    start_up_rmse: np.ndarray  # (n,), over the steps before 50
    score: Interval  # mean over states of RMSE over scale [-]
    output_rmse: Mapping[str, Interval]  # by symbol, of the output that the filter's model has at its estimate
    nees: Interval  # mean; expected value n; NaN for filters without a covariance
    median_nees: float  # expected value 1.39 for two states; robust where a few steps dominate the mean
    nis: Interval  # mean ...
    expected_nis: float  # ... and its expected value: m, or less where channels are missing at times
    channels: int  # m
    log_likelihood: float  # mean over seeds of the sum over scored steps; NaN for filters without a covariance
    log_likelihoods: np.ndarray  # (B,), of each run, for paired comparisons
    divergences: int  # filter resets (restarts from the prior), over all seeds
    mean_squares: np.ndarray  # (B, n), mean square error of each run, for paired comparisons
    scale: np.ndarray  # (n,), by which the score divides errors
    weights: np.ndarray | None = None  # (B,), number of scored steps of each run; None where they are all the same
    log_score: Interval = NOTHING  # mean of log N(x; x^, P) a scored step, of the states that count
    nees_variance: float = np.nan  # variance over a run's steps, mean over runs, over its expected value, 2 n
    nis_variance: float = np.nan  # the same of the NIS; its expected value is 2 m where nothing is missing
    restarts: Restarts | None = None  # the first restart, and why; None if there is none
    state_nees: np.ndarray | None = None  # (n,), means of e_i^2 / P_ii, expected value 1; NaN where there is none
    time_constants: TimeConstants | None = None  # of its gain; None without one, and where nobody asked for them
    uneven: UnevenNis | None = None  # a mean NIS that a few blocks of logs carry; None if none do, or if not asked

    @property
    def has_truth(self) -> bool:
        """Whether the estimates could be compared with a truth."""
        return not np.isnan(self.mean_squares).all()

    @property
    def scored(self) -> list[int]:
        """Indices of the scored states."""
        return np.flatnonzero(np.isfinite(self.scale)).tolist()

    @property
    def scored_nees(self) -> dict[str, float]:
        """Mean e_i^2 / P_ii of each scored state by its label, expected value 1; empty if there is none."""
        ratios = () if self.state_nees is None else self.state_nees.tolist()
        return {self.states[i].short_label: ratios[i] for i in self.scored if ratios and not np.isnan(ratios[i])}


def farthest(ratios: Iterable[float]) -> float:
    """The ratio that is farthest from 1, up or down; NaN if there is none."""
    known = [ratio for ratio in ratios if ratio >= 0.0]
    return max(known, key=lambda ratio: abs(np.log(ratio)) if ratio else np.inf, default=np.nan)


def is_beyond(ratio: float) -> bool:
    """Whether a mean NEES over its expected value is off by more than a factor of three, up or down."""
    return not 1.0 / FARTHEST_NEES <= ratio <= FARTHEST_NEES and not np.isnan(ratio)


def evaluate(filter_: Filter, data: Data, scale) -> Evaluation:
    """Run a filter over all seeds of some data in compiled, parallel calls, and compute its metrics.

    Args:
        filter_: the filter; if it estimates more than the plant's n states, these come first.
        data: inputs and measurements, and the truth if known.
        scale: (n,) by which the score divides errors, the problem's `scale`: infinite for states that are not
            scored; None without truth.

    Raises:
        ValueError: if the scale is not positive, or not one number for each state.
    """
    counted = None
    if data.states is not None:
        counted = _checked(scale, len(tangent_of(filter_.model, data.states.shape[-1])))
    runs = metrics_of_all(filter_, data, scale=counted)
    return with_restarts(compute_metrics(filter_, runs, data, scale), filter_, runs, data)


def with_restarts(evaluation: Evaluation, filter_: Filter, runs: RunMetrics, data: Data) -> Evaluation:
    """An evaluation with the first restart, and why, if there is one: its run is stepped once more."""
    lost = np.flatnonzero(runs.divergences).tolist()
    if not lost:
        return evaluation
    run_data, index = data.one(lost[0]), lost[0]
    restarts = restarts_of(
        filter_, runs.divergences[index], run_data.filter_keys, run_data.inputs, run_data.measurements
    )
    assert restarts is not None  # it has restarted
    return evaluation._replace(
        restarts=restarts._replace(
            times=evaluation.divergences, runs=len(lost), of_runs=len(runs.divergences), run=index
        )
    )


def restart_sentences(evaluations: Mapping[str, Evaluation]) -> list[str]:
    """Restarts of filters by name, a sentence a filter that restarted."""
    return [
        f"{name}: {evaluation.restarts.sentence}"
        for name, evaluation in evaluations.items()
        if evaluation.restarts
    ]


def values_of(filter_: Filter, data: Data, scale) -> Evaluation:
    """A faster `evaluate`: values without intervals, NEES and derived outputs."""
    return compute_metrics(filter_, metrics_of_all(filter_, data, False, False), data, scale, False, False)


def variance_ratios(runs: RunMetrics) -> tuple[float, float]:
    """Variances of NEES and NIS over a run's steps over those of chi-squares, means over runs; NaN for none.

    A chi-square of m degrees of freedom has the variance 2 m; if the number of measured channels varies, its
    variance is added.
    """
    degrees = runs.present[runs.present > 0]
    nis = _variance_over_steps(runs.nis) / (2.0 * degrees.mean() + degrees.var()) if degrees.size else np.nan
    if runs.nees is None or runs.mean_squares is None:
        return np.nan, nis
    return _variance_over_steps(runs.nees) / (2.0 * runs.mean_squares.shape[1]), nis


def _variance_over_steps(values: np.ndarray) -> float:
    """Variance of values (B, T) over each run's steps that are not NaN, mean over runs that have two of them."""
    present = ~np.isnan(values)
    several = present.sum(axis=1) > 1
    present, counts = present[several], present[several].sum(axis=1)
    if not counts.size:
        return np.nan
    means = np.where(present, values[several], 0.0).sum(axis=1) / counts
    squares = np.where(present, values[several] - means[:, None], 0.0) ** 2
    return float((squares.sum(axis=1) / (counts - 1)).mean())


def compute_metrics(
    filter_: Filter, runs: RunMetrics, data: Data, scale, intervals: bool = True, variances: bool = True
) -> Evaluation:
    """Metrics of a filter from those of its runs; other arguments and errors are those of `evaluate`.

    Without intervals their ends are NaN: a trial of a study needs none, and they take longer than the values,
    as do variances of NEES and NIS.
    """
    counts = runs.present[runs.present > 0]
    nees_variance, nis_variance = variance_ratios(runs) if variances else (np.nan, np.nan)
    return Evaluation(
        **_errors(filter_, runs, data, scale, intervals),
        nis=mean_interval(runs.nis, intervals, POSITIVE),
        expected_nis=float(counts.mean()) if counts.size else np.nan,
        channels=filter_.model.m,
        log_likelihood=float(runs.log_likelihoods.mean()),
        log_likelihoods=runs.log_likelihoods,
        weights=runs.weights,
        divergences=int(runs.divergences.sum()),
        log_score=NOTHING if runs.log_scores is None else mean_interval(runs.log_scores, intervals),
        nees_variance=nees_variance,
        nis_variance=nis_variance,
    )


def _errors(filter_: Filter, runs: RunMetrics, data: Data, scale, intervals: bool) -> dict:
    """The fields of an `Evaluation` that need the truth; NaN without it."""
    mean_squares, nees, start_up = runs.mean_squares, runs.nees, runs.start_up_squares
    if data.states is None or mean_squares is None or nees is None or start_up is None:
        states = tangent_of(filter_.model)[: None if scale is None else len(scale)]
        n = len(states)
        return {
            "states": states,
            "outputs": {},
            "rmse": (NOTHING,) * n,
            "start_up_rmse": np.full(n, np.nan),
            "score": NOTHING,
            "output_rmse": {},
            "nees": NOTHING,
            "median_nees": np.nan,
            "mean_squares": np.full((len(data.measurements), n), np.nan),
            "scale": np.full(n, np.nan),
            "state_nees": np.full(n, np.nan),
        }
    states = tangent_of(filter_.model, data.states.shape[-1])
    scale, weights, of_outputs = _checked(scale, len(states)), runs.weights, outputs_of(filter_.model)
    score_interval = without_interval(score(mean_squares, scale, weights))
    if intervals:
        resampled = _scores(np.sqrt(resampled_means(mean_squares, weights)), scale)
        score_interval = interval(score_interval.value, resampled, len(mean_squares), is_ratio=True)
    squares_of = runs.output_mean_squares.items()
    outputs = {symbol: rmse_intervals(squares, intervals, weights)[0] for symbol, squares in squares_of}
    return {
        "states": states,
        "outputs": {symbol: of_outputs[symbol] for symbol in outputs},
        "rmse": rmse_intervals(mean_squares, intervals, weights),
        "start_up_rmse": np.sqrt(start_up.mean(axis=(0, 1)) if data.counted is None else _mean_there(start_up)),
        "score": score_interval,
        "output_rmse": outputs,
        "nees": mean_interval(nees, intervals, POSITIVE),
        "median_nees": float(np.nanmedian(nees)) if np.isfinite(nees).any() else np.nan,
        "mean_squares": mean_squares,
        "scale": scale,
        "state_nees": None if runs.state_nees is None else pooled_mean(runs.state_nees, weights),
    }


def _mean_there(values: np.ndarray) -> np.ndarray:
    """Mean (n,) of values (B, T, n) without those that are NaN; NaN where there are no others."""
    known = ~np.isnan(values)
    counts = known.sum(axis=(0, 1))
    return np.where(counts > 0, np.where(known, values, 0.0).sum(axis=(0, 1)) / np.maximum(counts, 1), np.nan)


def _checked(scale, n: int) -> np.ndarray:
    scale = np.asarray(scale, dtype=np.float64)
    if scale.shape != (n,):
        raise ValueError(f"scale must be one number per state, {n}, but got {scale.tolist()}")
    if not (scale > 0).all():
        raise ValueError(f"scale must be positive in every state, but got {scale.tolist()}")
    if not np.isfinite(scale).any():
        raise ValueError(f"scale must be finite in some state, but got {scale.tolist()}")
    return scale


def check_consistency(filter_: Filter, data: Data, dt: float | None = None) -> ConsistencyReport:
    """Consistency of a filter's covariance on some data, and of an ensemble's members.

    Args:
        filter_: the filter.
        data: of at least two runs.
        dt: sample time [s], named in the report if the model blows up between samples.
    """
    model, members, first = filter_.model, None, data.first_scored
    observed, states = data.seen, None if data.states is None else data.known_states
    n = model.n if data.states is None else data.states.shape[-1]
    quantities = tangent_of(model, n)
    if filter_.size and data.states is not None and not model.turns:
        first_runs = (
            part[:MEMBER_RUNS] for part in (observed.filter_keys, observed.inputs, observed.measurements)
        )
        members = record_members(filter_, *first_runs, first=first, every=MEMBER_STEPS)
    angles = () if model.turns else model.any_shape.state_angles[:n]
    parts, blown = [], ""
    for runs, estimates in estimates_in_parts(filter_, data):
        blown = blown or blow_up(filter_, estimates, runs, dt)
        of_plant = estimates._replace(means=estimates.means[..., :n], covs=estimates.covs[..., :n, :n])
        truth, t = runs.states, len(quantities)
        if model.turns:  # errors on the tangent, and a truth of zero
            means = estimates.means[..., :t] if truth is None else errors_of(model, estimates.means, truth)
            of_plant = estimates._replace(means=means, covs=estimates.covs[..., :t, :t])
            truth = None if truth is None else np.zeros(means.shape)
        measured = readings(runs.measurements, model.measured_turns)
        parts.append(findings(of_plant, truth, measured, first, angles, runs.counted))
    report = report_of(
        joined(parts),
        states,
        members=members,
        first_step=first,
        names=[quantity.short_label for quantity in quantities],
        angles=angles,
        channels=[channel.label for channel in innovations_of(model)],
    )
    return report._replace(constants=tuple(getattr(model.constants, "_fields", ())), blown=blown)


def score(mean_squares: np.ndarray, scale: np.ndarray, weights: np.ndarray | None = None) -> float:
    """Mean over states of RMSE over scale, from mean square errors of runs (B, n), with weights if they differ."""
    return float(_scores(np.sqrt(pooled_mean(mean_squares, weights)), scale))


def mse(mean_squares: np.ndarray, scale: np.ndarray, weights: np.ndarray | None = None) -> float:
    """Sum over the scored states of mean square error over scale^2; arguments as in `score`."""
    counted = np.isfinite(scale)
    return float((pooled_mean(mean_squares, weights)[counted] / scale[counted] ** 2).sum())


def _scores(rmse: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Mean of RMSE (..., n) over scale, over the states that count: the others have an infinite scale."""
    counted = np.isfinite(scale)
    return (rmse[..., counted] / scale[counted]).mean(axis=-1)


def run_scores(runs: RunMetrics, scale) -> np.ndarray:
    """The score of each run, (B,): mean over states of its RMSE over scale; ValueError without truth."""
    if runs.mean_squares is None:
        raise ValueError("a score must be of runs with true states, but got runs without truth")
    return _scores(np.sqrt(runs.mean_squares), np.asarray(scale))


def score_ratio(a: Evaluation, b: Evaluation) -> Interval:
    """Score of a over that of b on the same seeds, with a paired bootstrap interval over seeds; NaN without truth.

    Raises:
        ValueError: if the two were not evaluated on equally many seeds.
    """
    _check_paired(a, b)
    if not (a.has_truth and b.has_truth):
        return NOTHING
    value = score(a.mean_squares, a.scale, a.weights) / score(b.mean_squares, b.scale, b.weights)
    return interval(value, resampled_ratios(a, b), len(a.mean_squares), is_ratio=True)


def median_score_ratio(a: Evaluation, b: Evaluation) -> float:
    """Median over runs of the ratio of the run's scores, which a few runs do not dominate; NaN without truth."""
    _check_paired(a, b)
    scores = [_scores(np.sqrt(evaluation.mean_squares), evaluation.scale) for evaluation in (a, b)]
    return float(np.median(scores[0] / scores[1]))


def resampled_ratios(a: Evaluation, b: Evaluation) -> np.ndarray:
    """Score of a over that of b for every bootstrap resample of their common runs."""
    scores = [_scores(np.sqrt(resampled_means(e.mean_squares, e.weights)), e.scale) for e in (a, b)]
    return scores[0] / scores[1]


def likelihood_gain(a: Evaluation, b: Evaluation) -> Interval:
    """Log-likelihood of a minus that of b, mean over runs with a paired interval: above 0, a predicts better.

    It needs no truth. NaN for a filter without a covariance.

    Raises:
        ValueError: if the two were not evaluated on equally many seeds.
    """
    _check_paired(a, b)
    return mean_interval(a.log_likelihoods - b.log_likelihoods)


def _check_paired(a: Evaluation, b: Evaluation) -> None:
    if a.mean_squares.shape != b.mean_squares.shape:
        raise ValueError(
            f"a paired comparison needs the same seeds, but got {len(a.mean_squares)} and {len(b.mean_squares)}"
        )


def blow_up(filter_: Filter, estimates: Estimates, data: Data, dt: float | None) -> str:
    """A sentence on a filter whose model blows up between samples, from its scored innovations; empty otherwise.

    Args:
        filter_: the filter of the estimates.
        estimates: on the same data.
        data: inputs and measurements.
        dt: sample time [s], if there is one.
    """
    model = filter_.model
    names = [channel.name for channel in innovations_of(model)]
    measured = readings(data.measurements, model.measured_turns)
    innovations, measurements = (data.late_scored(values) for values in (estimates.innovations, measured))
    return blow_up_sentence(innovations, measurements, names, dt)
