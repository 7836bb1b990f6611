"""One trial of a study: the same seeds for all trials, in blocks, and pruning.

In order: the pruner, which ends trials that are significantly worse than the best one; the cost of a filter's step
against a budget; the run of a trial; its outcome.
"""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from itertools import accumulate
from numbers import Real
from statistics import geometric_mean

import numpy as np
import optuna
from optuna.distributions import BaseDistribution
from optuna.trial import FrozenTrial, TrialState

from filters.engine.batch import run
from filters.filter import Filter
from tuning.evaluation.evaluate import Evaluation, compute_metrics, run_scores
from tuning.evaluation.runs import RunMetrics, joined, metrics_of_all
from tuning.problems.data import Data
from tuning.search.objectives import (
    LARGEST,
    LOG_SCORES,
    NEES,
    SCORE,
    VARIANCES,
    nis_ratio,
    nis_violation,
    penalised,
)
from tuning.search.plan import Plan
from tuning.search.space import Choice, suggest

BLOCK = 8  # seeds between two decisions whether to prune
P_THRESHOLD = 0.1  # p-value of Wilcoxon's signed-rank test below which a trial is pruned
MOST_EXACT = 50  # differences for which Optuna's test is the exact one
RUNS, STEPS = 32, 200  # of each timed call
FEWEST, MOST = 3, 15  # timed calls, of which the median is taken ...
ENOUGH_SECONDS = 0.1  # ... and which end early after this time
BUDGET = "cost a step over the budget"  # name of the constraint; at most zero within
COST = "microseconds a step"  # trial attribute
CONSISTENCY = "mean NIS outside its band"  # name of the constraint; at most zero is inside
NIS = "mean NIS over the number of channels"
NEAR = 2e-5  # relative difference of parameters, above which trials are certainly not equal


class PairedPruner(optuna.pruners.WilcoxonPruner):
    """Optuna's pruner, whose test is a comparison of two whole numbers in all but rare cases.

    Without ties the p-value of the signed-rank test depends on the sum of ranks alone, so the sum from which it is
    below the threshold is known beforehand. Optuna decides where there are ties or values that are not finite.
    """

    def __init__(self):
        """Take the threshold, and no decision before the first block."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
            super().__init__(p_threshold=P_THRESHOLD, n_startup_steps=BLOCK)

    def prune(self, study: optuna.Study, trial: FrozenTrial) -> bool:
        """Whether a trial of a study that minimises is significantly worse than its best one, and in the mean."""
        complete = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
        complete.sort(key=lambda finished: finished.values[0])  # so that few are asked for their constraints
        best_so_far = next(filter(_is_feasible, complete), None)
        if best_so_far is None:
            return False
        values, best = trial.intermediate_values, best_so_far.intermediate_values
        if not values or not best or not values.keys() <= best.keys() or not _all_finite(values, best):
            return super().prune(study, trial)
        if len(values) >= BLOCK and _mean(best) >= _mean(values):
            return False
        differences = [value - best[step] for step, value in values.items()]
        sizes = {abs(difference) for difference in differences}
        if not BLOCK <= len(differences) <= MOST_EXACT or len(sizes) < len(differences) or 0.0 in sizes:
            return super().prune(study, trial)
        return positive_rank_sum(differences) >= critical_rank_sum(len(differences), P_THRESHOLD)


def positive_rank_sum(differences: Sequence[float]) -> int:
    """Sum of the ranks of positive differences, ranked by size from 1; of differences without ties."""
    return sum(rank for rank, difference in enumerate(sorted(differences, key=abs), start=1) if difference > 0)


@cache
def critical_rank_sum(count: int, threshold: float) -> int:
    """The smallest sum of ranks of positive differences whose one-sided p-value is below a threshold.

    p(r) = P(R >= r), where R is the sum of a random subset of 1 ... count, all subsets being equally likely.

    Source: Wilcoxon (1945), "Individual comparisons by ranking methods", Biometrics Bulletin 1(6).
    """
    subsets = [1]  # number of subsets with each sum
    for rank in range(1, count + 1):
        longer = subsets + [0] * rank
        subsets = [n + (longer[r - rank] if r >= rank else 0) for r, n in enumerate(longer)]
    beyond = accumulate(reversed(subsets))  # number with this sum or a larger one, from the largest sum downwards
    return len(subsets) - sum(number < threshold * 2**count for number in beyond)


def _is_feasible(trial: FrozenTrial) -> bool:
    return all(value <= 0 for value in trial.constraints.values())


def _all_finite(*values: dict[int, float]) -> bool:
    return all(math.isfinite(value) for trial_values in values for value in trial_values.values())


def _mean(values: dict[int, float]) -> float:
    return sum(values.values()) / len(values)


def microseconds_a_step(filter_: Filter, data: Data) -> float:
    """Time of one core for a step of one run [us/step]: the median of several calls over a batch.

    It is processor time, summed over the cores that the batch uses: waiting for other processes and workers is
    not included. A first short call, which may compile, is not timed.
    """
    run(filter_, *_part(data, 2, 2))
    part = _part(data, RUNS, STEPS)
    seconds: list[float] = []
    while len(seconds) < FEWEST or (len(seconds) < MOST and sum(seconds) < ENOUGH_SECONDS):
        begin = time.process_time()
        run(filter_, *part)
        seconds.append(time.process_time() - begin)
    return 1e6 * float(np.median(seconds)) / part[2][..., 0].size


def _part(data: Data, runs: int, steps: int) -> tuple[np.ndarray, ...]:
    data = data.slice(0, runs).seen
    return data.filter_keys[:runs], data.inputs[:runs, :steps], data.measurements[:runs, : steps + 1]


def over_budget(microseconds: float, budget: float) -> float:
    """Logarithm of the cost over the budget; at most zero within the budget, as Optuna expects it."""
    return math.log(microseconds / budget)


def make_pruner(plan: Plan) -> optuna.pruners.BasePruner:
    """A paired test over seeds, or no pruning; two objectives are never pruned."""
    return PairedPruner() if plan.prune and len(plan.objectives) == 1 else optuna.pruners.NopPruner()


def run_trial(
    trial: optuna.Trial,
    plan: Plan,
    data: Sequence[Data],
    space: Mapping[str, BaseDistribution],
    on_choice: Callable[[Choice], None] = lambda choice: None,
) -> list[float]:
    """Values of a trial, one for each objective.

    Args:
        trial: from Optuna.
        plan: of the study.
        data: the plan's training data.
        space: the plan's space.
        on_choice: called with the choice of the trial.

    Raises:
        optuna.TrialPruned: if it is over the plan's budget, or significantly worse than the best one on the seeds
            so far.
    """
    choice = plan.forgetting(suggest(trial, plan.filter, plan.scenarios[0], space, plan.where))
    on_choice(choice)
    microseconds = math.nan
    if plan.asks_for_cost:
        microseconds = cost_of(choice, plan, data)
        trial.set_user_attr(COST, microseconds)
    if plan.budget is not None:
        trial.set_constraint(BUDGET, over_budget(microseconds, plan.budget))
        if microseconds > plan.budget:
            raise optuna.TrialPruned
    prunes = plan.prune and plan.objectives == (SCORE,) and not plan.worst
    evaluations = measure(choice, plan, data, trial if prunes else None)
    if plan.is_constrained:
        outside = max(map(nis_violation, evaluations))
        trial.set_constraint(CONSISTENCY, outside)
        if outside < LARGEST:  # otherwise there is no finite NIS
            trial.set_user_attr(NIS, geometric_mean(map(nis_ratio, evaluations)))
    of_all = max if plan.worst else np.mean
    return [
        float(of_all([penalised(objective.value(e, microseconds), e) for e in evaluations]))
        for objective in plan.found_objectives()
    ]


def cost_of(choice: Choice, plan: Plan, data: Sequence[Data]) -> float:
    """Cost of a choice [us/step], on the scenario where it is largest."""
    pairs = zip(plan.scenarios, data, strict=True)
    return max(microseconds_a_step(choice.filter(scenario), problem_data) for scenario, problem_data in pairs)


def measure(
    choice: Choice, plan: Plan, data: Sequence[Data], trial: optuna.Trial | None = None
) -> list[Evaluation]:
    """Run a choice on all data; with a trial, report each seed's score to it and stop if it should be pruned.

    All runs of all problems count. If problems have different numbers of runs, each reported score is of
    equal shares of the problems' runs: one run of the smallest problem, and the mean of several of the others'.

    The NEES and errors of outputs are computed if an objective needs them, intervals never.
    """
    objectives = plan.found_objectives()
    needs = {need for objective in objectives for need in objective.needs}
    nees, outputs = NEES in needs, any(objective.output for objective in objectives)
    scales = [scenario.scale if LOG_SCORES in needs else None for scenario in plan.scenarios]
    filters = [choice.filter(scenario) for scenario in plan.scenarios]
    count = min(len(problem_data.seeds) for problem_data in data)
    size = count if trial is None else BLOCK
    ends = [shares(len(problem_data.seeds), count) for problem_data in data]
    parts: list[list[RunMetrics]] = [[] for _ in filters]
    for first in range(0, count, size):
        last = min(first + size, count)
        for runs, filter_, problem_data, bounds, scale in zip(parts, filters, data, ends, scales, strict=True):
            runs.append(
                metrics_of_all(filter_, problem_data.slice(bounds[first], bounds[last]), nees, outputs, scale)
            )
        if trial is not None:
            _report(trial, first, last, [runs[-1] for runs in parts], ends, plan)
            if last < count and trial.should_prune():
                raise optuna.TrialPruned
    rows = zip(filters, map(joined, parts), data, plan.scenarios, strict=True)
    return [
        compute_metrics(filter_, runs, problem_data, scenario.scale, False, VARIANCES in needs)
        for filter_, runs, problem_data, scenario in rows
    ]


def shares(runs: int, count: int) -> list[int]:
    """Ends of `count` nearly equal shares of some runs: share i is ends[i] up to, but without, ends[i + 1]."""
    return [i * runs // count for i in range(count + 1)]


def _report(
    trial: optuna.Trial, first: int, last: int, parts: list[RunMetrics], ends: list[list[int]], plan: Plan
) -> None:
    """Report the mean over problems of the scores of their shares `first` up to, without, `last`."""
    scores = []
    for runs, scenario, bounds in zip(parts, plan.scenarios, ends, strict=True):
        begin = np.subtract(bounds[first:last], bounds[first])
        sizes = np.diff(bounds[first : last + 1])
        scores.append(np.add.reduceat(run_scores(runs, scenario.scale), begin) / sizes)
    for index, score in enumerate(np.mean(scores, axis=0)):
        trial.report(float(score), first + index)


# The outcome of trials: constraints, and the best trial.


def best_trial(trials: Sequence[FrozenTrial]) -> FrozenTrial | None:
    """The complete trial with the lowest first objective, among the consistent ones if there are any.

    A trial over the budget is never complete. If no trial is consistent, the distance of the mean NIS from its
    band is ignored: an estimate that is many times worse can be closer to it.
    """
    complete = [trial for trial in trials if trial.state == TrialState.COMPLETE]
    complete.sort(key=lambda trial: trial.values[0])  # so that few are asked for their constraints
    return next(filter(is_consistent, complete), complete[0] if complete else None)


def is_consistent(trial: FrozenTrial) -> bool:
    """Whether a trial's mean NIS is inside its band; true without a band."""
    return violation(trial) <= 0


def violation(trial: FrozenTrial) -> float:
    """Logarithmic distance of a trial's mean NIS from its band; at most zero inside, or without a band."""
    return trial.constraints.get(CONSISTENCY, 0.0)


def is_over_budget(trial: FrozenTrial) -> bool:
    """Whether a trial ended because its filter is over the budget."""
    return trial.constraints.get(BUDGET, 0.0) > 0


# Trials that are enqueued unless there is one with the same parameters.


def enqueue_new(study: optuna.Study, parameters: dict, attributes: dict) -> None:
    """Enqueue a trial unless there is one with these parameters.

    Optuna compares it with all trials, one parameter at a time by NumPy: so it is asked only where one is near.
    """
    trials = study.get_trials(deepcopy=False)
    near = any(not trial.state.is_finished() or is_near(trial.params, parameters) for trial in trials)
    study.enqueue_trial(parameters, user_attrs=attributes, skip_if_exists=near)


def is_near(parameters: dict, other: dict) -> bool:
    """Whether no parameter that both have differs by more than what Optuna takes as equal, 1e-5."""
    for name, value in other.items():
        if isinstance(value, Real) and isinstance(parameters.get(name, ""), Real):
            if not math.isclose(value, parameters[name], rel_tol=NEAR):
                return False
        elif name in parameters and parameters[name] != value:
            return False
    return True
