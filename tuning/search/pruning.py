"""Which trials are pruned: those that are significantly worse than the best one on the seeds so far."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from functools import cache
from itertools import accumulate

import optuna
from optuna.trial import FrozenTrial, TrialState

BLOCK = 8  # seeds between two decisions whether to prune
P_THRESHOLD = 0.1  # p-value of Wilcoxon's signed-rank test below which a trial is pruned
MOST_EXACT = 50  # differences for which Optuna's test is the exact one


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
