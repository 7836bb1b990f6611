"""Filters on validation seeds: an objective with each run left out once, for paired comparisons by jackknife."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from filters.consistency.intervals import Interval
from tuning.evaluation.evaluate import Evaluation, compute_metrics, mse, score
from tuning.evaluation.runs import RunMetrics, metrics_of_all
from tuning.problems.data import Data
from tuning.search.objectives import DIVERGENCE_PENALTY, LARGEST, LOG_SCORE, MSE, OUTPUT, PROPER, nis_ratio
from tuning.search.plan import Plan
from tuning.search.space import Choice

LEVEL = 0.05  # of a two-sided interval


class Measured(NamedTuple):
    """A filter on some problems: the objective of a study, and the same with each run left out."""

    value: float
    left_out: tuple[np.ndarray, ...]  # (B,) of each problem: the whole objective without that problem's run b
    proper: float  # mean log score of the state a step; without truth log-likelihood of the innovations of a run
    nis: tuple[float, ...]  # mean NIS over the number of channels, on each problem


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
    proper = float(np.mean([proper for _, _, proper, _ in found]))
    return Measured(value, parts, proper, tuple(nis for *_, nis in found))


def _on(choice: Choice, problem, data: Data, plan: Plan) -> tuple[float, np.ndarray, float, float]:
    """The objective, the same without each run (B,), the proper score and the mean NIS over its expected value."""
    filter_ = choice.filter(problem)
    by_output = plan.found_objectives()[0].output
    all_runs = metrics_of_all(filter_, data, False, bool(by_output), problem.scale)
    evaluation = compute_metrics(filter_, all_runs, data, problem.scale, False, False)
    value, parts = _values(plan.objectives[0], by_output, all_runs, evaluation)
    restarts = all_runs.divergences
    value += DIVERGENCE_PENALTY * restarts.sum()
    parts = parts + DIVERGENCE_PENALTY * (restarts.sum() - restarts)
    proper = evaluation.log_score.value
    proper = evaluation.log_likelihood if math.isnan(proper) else proper
    return value, parts, proper, nis_ratio(evaluation)


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
    from scipy.special import stdtrit

    def between(a, b):
        return np.log(a / b) if ratio else a - b

    value, variance, freedom = float(between(one.value, other.value)), 0.0, 0
    for a, b in zip(one.left_out, other.left_out, strict=True):
        each, count = between(a, b), len(a)
        variance += (count - 1) / count * float(((each - each.mean()) ** 2).sum())
        freedom += count - 1
    quantile = float(stdtrit(freedom, 1.0 - LEVEL / 2.0)) if freedom else math.inf
    half = quantile * math.sqrt(variance) if freedom else math.inf
    ends = value, value - half, value + half
    return Interval(*(math.exp(min(end, 700.0)) if ratio else end for end in ends))
