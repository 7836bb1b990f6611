"""Filters on validation seeds: an objective with each run left out once, for paired comparisons by jackknife."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from filters.consistency.intervals import Interval
from tuning.evaluation.evaluate import Evaluation, compute_metrics, farthest, mse, score
from tuning.evaluation.runs import RunMetrics, metrics_of_all
from tuning.problems.data import Data
from tuning.search.objectives import (
    DIVERGENCE_PENALTY,
    LARGEST,
    LOG_SCORE,
    MSE,
    OUTPUT,
    PROPER,
    nees_ratio,
    nis_ratio,
)
from tuning.search.plan import Plan
from tuning.search.space import Choice

LEVEL = 0.05  # of a two-sided interval


class Measured(NamedTuple):
    """A filter on some problems: the objective of a study, and the same with each run left out."""

    value: float
    left_out: tuple[np.ndarray, ...]  # (B,) of each problem: the whole objective without that problem's run b
    proper: float  # mean log score of the state a step; without truth log-likelihood of the innovations of a run
    nis: tuple[float, ...]  # mean NIS over the number of channels, on each problem
    log_scores: tuple[
        np.ndarray, ...
    ] = ()  # `proper` with each run left out, (B,); empty unless it is a log score
    nees: float = math.nan  # mean NEES over the number of states, on the problem where it is farthest from 1
    state_nees: float = math.nan  # that of a scored state over 1, where it is farthest


def measured(choice: Choice, plan: Plan, data: Sequence[Data]) -> Measured:
    """Run a choice on all data and measure the plan's first objective, with its penalty for each restart."""
    found = [_on(choice, problem, one, plan) for problem, one in zip(plan.scenarios, data, strict=True)]
    wholes = [whole for whole, *_ in found]
    if plan.worst:
        rest = [max((*wholes[:i], *wholes[i + 1 :]), default=-math.inf) for i in range(len(found))]
        value, parts = max(wholes), tuple(np.maximum(one[1], rest[i]) for i, one in enumerate(found))
    else:
        value = float(np.mean(wholes))
        parts = tuple(value + (parts - whole) / len(found) for whole, parts, *_ in found)
    evaluations = [evaluation for _, _, evaluation, _ in found]
    scored = not any(math.isnan(one.log_score.value) for one in evaluations)
    proper = float(np.mean([one.log_score.value if scored else one.log_likelihood for one in evaluations]))
    others = [proper + (others - one.log_score.value) / len(found) for *_, one, others in found] if scored else ()
    states = [ratio for one in evaluations for ratio in one.scored_nees.values()]
    nees = farthest(map(nees_ratio, evaluations)), farthest(states)
    return Measured(value, parts, proper, tuple(map(nis_ratio, evaluations)), tuple(others), *nees)


def _on(choice: Choice, problem, data: Data, plan: Plan) -> tuple[float, np.ndarray, Evaluation, np.ndarray]:
    """The objective, the same without each run (B,), all metrics, and the log score without each run (B,)."""
    filter_ = choice.filter(problem)
    by_output = plan.found_objectives()[0].output
    all_runs = metrics_of_all(filter_, data, True, bool(by_output), problem.scale)
    evaluation = compute_metrics(filter_, all_runs, data, problem.scale, False, False)
    value, parts = _values(plan.objectives[0], by_output, all_runs, evaluation)
    restarts = all_runs.divergences
    value += DIVERGENCE_PENALTY * restarts.sum()
    parts = parts + DIVERGENCE_PENALTY * (restarts.sum() - restarts)
    log_scores = np.asarray(math.nan)
    if not math.isnan(evaluation.log_score.value):
        log_scores = -_values(LOG_SCORE, "", all_runs, evaluation)[1]
    return value, parts, evaluation, log_scores


def _values(objective: str, output: str, runs: RunMetrics, evaluation: Evaluation) -> tuple[float, np.ndarray]:
    """An objective of all runs, and of all but each one (B,), both finite."""
    if objective in PROPER:
        totals, counts = -runs.log_likelihoods, np.ones(len(runs.divergences))
        if objective == LOG_SCORE:  # over steps, of which runs may have more or fewer
            steps = np.asarray(runs.log_scores)
            totals, counts = -np.nansum(steps, axis=1), (~np.isnan(steps)).sum(axis=1)
        others = np.maximum(counts.sum() - counts, 1)
        return _finite(totals.sum() / counts.sum()), _finite((totals.sum() - totals) / others)
    squares, scale = runs.mean_squares, evaluation.scale
    if objective.startswith(OUTPUT) or output:
        squares, scale = runs.output_mean_squares[output], np.ones(1)
    if squares is None:
        raise ValueError("an error must be of runs with true states, but got runs without truth")
    weights = runs.counts[:, None].astype(np.float64)
    with np.errstate(invalid="ignore", divide="ignore"):
        others = ((weights * squares).sum(axis=0) - weights * squares) / (weights.sum() - weights)
    counted = np.isfinite(scale)
    with np.errstate(invalid="ignore"):
        relative = np.maximum(others[:, counted], 0.0) / scale[counted] ** 2
        parts = relative.sum(axis=1) if objective == MSE else np.sqrt(relative).mean(axis=1)
    error = mse if objective == MSE else score
    return _finite(error(squares, scale, runs.weights)), _finite(parts)


def _finite(value):
    """What a study takes in place of an infinite value, or none."""
    return np.clip(np.nan_to_num(value, nan=LARGEST, posinf=LARGEST, neginf=-LARGEST * 1e6), None, LARGEST * 1e6)


def over(one: Measured, other: Measured, *, ratio: bool) -> Interval:
    """The ratio (or difference) of two objectives on the same runs, with Student's interval by the jackknife.

        theta = log(V_1 / V_2),   var = sum over problems of (B - 1)/B sum_b (theta_(b) - mean theta_(b))^2

    It is paired: each run is left out of both. Below 1 (or 0) the first is better.

    Args:
        one: of one filter.
        other: of the other, on the same runs.
        ratio: whether objectives are errors, compared by their ratio; otherwise by their difference.

    Source: Efron, Stein (1981), "The jackknife estimate of variance", Annals of Statistics 9(3).
    """

    def between(a, b):
        return np.log(a / b) if ratio else a - b

    each = [between(a, b) for a, b in zip(one.left_out, other.left_out, strict=True)]
    ends = _jackknife(float(between(one.value, other.value)), each)
    return Interval(*(math.exp(min(end, 700.0)) if ratio else end for end in ends))


def log_score_gain(one: Measured, other: Measured) -> Interval:
    """The log score of the true states [nat a step] of one filter minus another's, with the interval of `over`."""
    each = [a - b for a, b in zip(one.log_scores, other.log_scores, strict=True)]
    return _jackknife(one.proper - other.proper, each)


def _jackknife(value: float, left_out: Sequence[np.ndarray]) -> Interval:
    """A value with Student's interval, from the values without each run of each problem."""
    from scipy.special import stdtrit

    variance, freedom = 0.0, 0
    for each in left_out:
        count = len(each)
        variance += (count - 1) / count * float(((each - each.mean()) ** 2).sum())
        freedom += count - 1
    quantile = float(stdtrit(freedom, 1.0 - LEVEL / 2.0)) if freedom else math.inf
    half = quantile * math.sqrt(variance) if freedom else math.inf
    return Interval(value, value - half, value + half)
