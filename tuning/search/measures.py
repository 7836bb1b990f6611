"""Filters on validation seeds: an objective of each run, and with each run left out, for paired comparisons."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from filters.consistency.nees import Interval
from tuning.evaluation.evaluate import Evaluation, compute_metrics, farthest, mse, score
from tuning.evaluation.runs import RunMetrics, metrics_of_all
from tuning.problems.data import Data
from tuning.search.plan import (
    DIVERGENCE_PENALTY,
    LARGEST,
    LOG_SCORE,
    MSE,
    OUTPUT,
    PROPER,
    Plan,
    nees_ratio,
    nis_ratio,
)
from tuning.search.space import Choice

LEVEL = 0.05  # of a two-sided interval
ONE_ERROR = 0.16  # one-sided level: a loss of about one standard error
FEWEST = 3  # runs of a log, of which a loss or an autocorrelation is computed
MOST_CORRELATED = 0.8  # autocorrelation of neighbouring blocks, as far as an effective number is computed


class Runs(NamedTuple):
    """A filter in each of the B runs of a problem."""

    values: np.ndarray  # (B, 1), the objective of each run; of errors (B, k), square errors of states over scale
    nis: np.ndarray  # (B,), sum over scored steps
    channels: np.ndarray  # (B,), number of measured values, the expected sum
    logs: np.ndarray | None = None  # (B,), the log of each block, in order of time; None for independent runs


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
    runs: tuple[Runs, ...] = ()  # of each problem
    decisive: tuple[int, ...] = ()  # the problems that determine the objective: all, or the worst one


def measured(choice: Choice, plan: Plan, data: Sequence[Data]) -> Measured:
    """Run a choice on all data and measure the plan's first objective, with its penalty for each restart."""
    results = [
        _on(choice, problem, problem_data, plan)
        for problem, problem_data in zip(plan.scenarios, data, strict=True)
    ]
    wholes = [objective for objective, *_ in results]
    decisive = (int(np.argmax(wholes)),) if plan.worst else tuple(range(len(results)))
    if plan.worst:
        rest = [max((*wholes[:i], *wholes[i + 1 :]), default=-math.inf) for i in range(len(results))]
        value, parts = max(wholes), tuple(np.maximum(result[1], rest[i]) for i, result in enumerate(results))
    else:
        value = float(np.mean(wholes))
        parts = tuple(value + (parts - objective) / len(results) for objective, parts, *_ in results)
    evaluations = [evaluation for _, _, evaluation, *_ in results]
    scored = not any(math.isnan(evaluation.log_score.value) for evaluation in evaluations)
    proper = float(
        np.mean(
            [evaluation.log_score.value if scored else evaluation.log_likelihood for evaluation in evaluations]
        )
    )
    log_scores = (
        [
            proper + (left_out - evaluation.log_score.value) / len(results)
            for *_, evaluation, left_out, _ in results
        ]
        if scored
        else ()
    )
    states = [ratio for evaluation in evaluations for ratio in evaluation.scored_nees.values()]
    nees = farthest(map(nees_ratio, evaluations)), farthest(states)
    nis, runs = tuple(map(nis_ratio, evaluations)), tuple(runs for *_, runs in results)
    return Measured(value, parts, proper, nis, tuple(log_scores), *nees, runs, decisive)


def _on(choice: Choice, problem, data: Data, plan: Plan) -> tuple[float, np.ndarray, Evaluation, np.ndarray, Runs]:
    """The objective, the same without each run (B,), all metrics, the log score without each run, and the runs."""
    filter_ = choice.filter(problem)
    by_output = plan.found_objectives()[0].output
    all_runs = metrics_of_all(filter_, data, True, bool(by_output), problem.scale)
    evaluation = compute_metrics(filter_, all_runs, data, problem.scale, False, False)
    value, parts, each = _values(plan.objectives[0], by_output, all_runs, evaluation)
    restarts = all_runs.divergences
    value += DIVERGENCE_PENALTY * restarts.sum()
    parts = parts + DIVERGENCE_PENALTY * (restarts.sum() - restarts)
    log_scores = np.asarray(math.nan)
    if not math.isnan(evaluation.log_score.value):
        log_scores = -_values(LOG_SCORE, "", all_runs, evaluation)[1]
    sums = np.nansum(all_runs.nis, axis=1), all_runs.present.sum(axis=1)
    runs = Runs(each + DIVERGENCE_PENALTY * restarts[:, None], *sums, problem.logs_of(data.seeds))
    return value, parts, evaluation, log_scores, runs


def _values(
    objective: str, output: str, runs: RunMetrics, evaluation: Evaluation
) -> tuple[float, np.ndarray, np.ndarray]:
    """An objective of all runs, of all but each one (B,), and its parts in each run (B, k), all finite."""
    if objective in PROPER:
        totals, counts = -runs.log_likelihoods, np.ones(len(runs.divergences))
        if objective == LOG_SCORE:  # over steps, of which runs may have more or fewer
            steps = np.asarray(runs.log_scores)
            totals, counts = -np.nansum(steps, axis=1), (~np.isnan(steps)).sum(axis=1)
        left_out = np.maximum(counts.sum() - counts, 1)
        each = _finite(totals / np.maximum(counts, 1))[:, None]
        return _finite(totals.sum() / counts.sum()), _finite((totals.sum() - totals) / left_out), each
    squares, scale = runs.mean_squares, evaluation.scale
    if objective.startswith(OUTPUT) or output:
        squares, scale = runs.output_mean_squares[output], np.ones(1)
    if squares is None:
        raise ValueError("an error must be of runs with true states, but got runs without truth")
    weights = runs.counts[:, None].astype(np.float64)
    with np.errstate(invalid="ignore", divide="ignore"):
        left_out = ((weights * squares).sum(axis=0) - weights * squares) / (weights.sum() - weights)
    counted = np.isfinite(scale)
    with np.errstate(invalid="ignore"):
        relative, each = (
            np.maximum(errors[:, counted], 0.0) / scale[counted] ** 2 for errors in (left_out, squares)
        )
        parts = relative.sum(axis=1) if objective == MSE else np.sqrt(relative).mean(axis=1)
    if objective == MSE:
        each = each.sum(axis=1, keepdims=True)
    error = mse if objective == MSE else score
    return _finite(error(squares, scale, runs.weights)), _finite(parts), _finite(each)


def _finite(value):
    """What a study takes in place of an infinite value, or none."""
    return np.clip(np.nan_to_num(value, nan=LARGEST, posinf=LARGEST, neginf=-LARGEST * 1e6), None, LARGEST * 1e6)


def over(result: Measured, other: Measured, *, ratio: bool) -> Interval:
    """The ratio (or difference) of two objectives on the same runs, with Student's interval by the jackknife.

        theta = log(V_1 / V_2),   var = sum over problems of (B - 1)/B sum_b (theta_(b) - mean theta_(b))^2

    It is paired: each run is left out of both. Below 1 (or 0) the first is better.

    Args:
        result: of one filter.
        other: of the other, on the same runs.
        ratio: whether objectives are errors, compared by their ratio; otherwise by their difference.

    Source: Efron, Stein (1981), "The jackknife estimate of variance", Annals of Statistics 9(3).
    """

    def between(a, b):
        return np.log(a / b) if ratio else a - b

    each = [between(a, b) for a, b in zip(result.left_out, other.left_out, strict=True)]
    ends = _jackknife(float(between(result.value, other.value)), each, result.runs)
    return Interval(*(math.exp(min(end, 700.0)) if ratio else end for end in ends))


def log_score_gain(result: Measured, other: Measured) -> Interval:
    """The log score of the true states [nat a step] of one filter minus another's, with the interval of `over`."""
    each = [a - b for a, b in zip(result.log_scores, other.log_scores, strict=True)]
    return _jackknife(result.proper - other.proper, each, result.runs)


def _jackknife(value: float, left_out: Sequence[np.ndarray], runs: Sequence[Runs]) -> Interval:
    """A value with Student's interval, from the values without each run of each problem."""
    from scipy.special import stdtrit

    variance, freedom = 0.0, 0
    for i, each in enumerate(left_out):
        count, logs = len(each), runs[i].logs if runs else None
        variance += (count - 1) / count * float(((each - each.mean()) ** 2).sum()) * _inflation(each, logs)
        freedom += count - 1
    quantile = float(stdtrit(freedom, 1.0 - LEVEL / 2.0)) if freedom else math.inf
    half = quantile * math.sqrt(variance) if freedom else math.inf
    return Interval(value, value - half, value + half)


def signed_rank(result: Measured, other: Measured, *, ratio: bool) -> float:
    """One-sided p-value of "one filter is no better than the other in most runs", by Wilcoxon's signed ranks.

        d_b = v_1b - v_2b   or, of errors,   d_b = sum_i (m_1bi - m_2bi) / sqrt(mean_b m_1bi + mean_b m_2bi),
        T = sum_b sign(d_b) rank(|d_b|),   p = Phi((T + 1) / sqrt(f sum_b rank^2)),   f = (1 + r)/(1 - r)

    with the objective v or the mean square errors m_i of states over their scale in run b. The second is the part
    of a run in the difference of scores, to first order: the median of ratios favours filters that are better in
    easy runs. A single run counts as one rank however much it differs, so that a heavy tail does not hide what all
    other runs say. Of blocks of logs r is the autocorrelation of neighbours.

    Args:
        result: of one filter.
        other: of the other, on the same runs.
        ratio: whether objectives are errors, compared by their ratio; otherwise by their difference.

    Sources: F. Wilcoxon (1945), "Individual comparisons by ranking methods", Biometrics Bulletin 1(6); G. V.
    Bayley, J. M. Hammersley (1946), "The 'effective' number of independent observations in an autocorrelated time
    series", Suppl. J. Royal Statistical Society 8(2).
    """
    return _rank_chance(_differences(result, other, ratio)) if result.runs else 1.0


def is_better(result: Measured, other: Measured, *, ratio: bool) -> bool:
    """Whether a filter is significantly better by the interval of `over`, or as a whole and by signed ranks."""
    interval, equal = over(result, other, ratio=ratio), 1.0 if ratio else 0.0
    return interval.high < equal or (
        interval.value < equal and signed_rank(result, other, ratio=ratio) < LEVEL / 2.0
    )


def logs_with_loss(result: Measured, other: Measured, *, ratio: bool) -> list[tuple[int, int]]:
    """The logs, as (problem, log), in which one filter is worse by a standard error, in the mean or by ranks.

    Blocks of another log, to come, may resemble those of any one log and not their mixture.
    """
    from scipy.special import stdtr

    lost, problems = [], _decisive_problems(result, other)
    for problem, (each, logs) in zip(problems, _differences(result, other, ratio), strict=True):
        for log in [] if logs is None else np.unique(logs).tolist():
            gain = -each[logs == log]
            if len(gain) < FEWEST or not gain.any():
                continue
            error = gain.std(ddof=1) / math.sqrt(len(gain))
            by_mean = stdtr(len(gain) - 1, gain.mean() / error) if error > 0 else float(gain[0] > 0)
            if min(by_mean, _rank_chance([(gain, None)])) < ONE_ERROR:
                lost.append((problem, log))
    return lost


def _decisive_problems(result: Measured, other: Measured) -> list[int]:
    return sorted({*result.decisive, *other.decisive})


def _differences(result: Measured, other: Measured, ratio: bool) -> list[tuple[np.ndarray, np.ndarray | None]]:
    """Differences of runs (B,), negative where the first filter is better, and their logs, by decisive problem."""
    differences = []
    for problem in _decisive_problems(result, other):
        a, b = result.runs[problem].values, other.runs[problem].values
        weights = a.mean(axis=0) + b.mean(axis=0) if ratio else np.ones(a.shape[1])
        weights = np.where(weights > 0.0, weights, 1.0)  # a state without any error
        differences.append((((a - b) / np.sqrt(weights)).sum(axis=1), result.runs[problem].logs))
    return differences


def _rank_chance(parts: Sequence[tuple[np.ndarray, np.ndarray | None]]) -> float:
    """The p-value of the signed ranks of differences and their logs; ties share ranks, equal runs have none."""
    from scipy.special import ndtr

    differences = np.concatenate([each for each, _ in parts])
    _, inverse, counts = np.unique(np.abs(differences), return_inverse=True, return_counts=True)
    ranks = np.sign(differences) * (np.cumsum(counts) - (counts - 1) / 2.0)[inverse]
    ends = np.cumsum([len(each) for each, _ in parts])[:-1]
    split = zip(np.split(ranks, ends), parts, strict=True)
    variance = sum(float(part @ part) * _inflation(part, logs) for part, (_, logs) in split)
    return float(ndtr((ranks.sum() + 1.0) / math.sqrt(variance))) if variance else 1.0


def _inflation(values: np.ndarray, logs: np.ndarray | None) -> float:
    """The number of blocks over their effective number, (1 + r)/(1 - r); 1 for independent runs.

    The autocorrelation r of neighbouring blocks of a log, about the mean of that log and with its bias 1/B
    removed, counts where it exceeds its own standard error 1/sqrt(B).
    """
    if logs is None:
        return 1.0
    products = squares = 0.0
    for log in np.unique(logs):
        rest = values[logs == log]
        if len(rest) >= FEWEST:
            rest = rest - rest.mean()
            squares += float(rest @ rest)
            products += float(rest[1:] @ rest[:-1]) + float(rest @ rest) / len(rest)
    r = min(products / squares, MOST_CORRELATED) if squares > 0 else 0.0
    return (1.0 + r) / (1.0 - r) if r > 1.0 / math.sqrt(len(values)) else 1.0
