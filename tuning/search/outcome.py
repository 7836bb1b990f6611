"""The outcome of trials: constraints, and the best trial.

NIS is the normalised innovation squared.
"""

from __future__ import annotations

from collections.abc import Sequence

from optuna.trial import FrozenTrial, TrialState

from tuning.search.cost import BUDGET
from tuning.search.trials import CONSISTENCY


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
