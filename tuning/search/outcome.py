"""How a trial ended: whether it keeps to its constraints, and which one is best."""

from __future__ import annotations

from collections.abc import Sequence

from optuna.trial import FrozenTrial, TrialState

from tuning.search.cost import BUDGET
from tuning.search.trials import CONSISTENCY


def best_trial(trials: Sequence[FrozenTrial]) -> FrozenTrial | None:
    """The complete trial with the least first objective, of consistent ones wherever there are any.

    A trial over the budget is never complete. Where none is consistent, a mean NIS nearer to its band would be
    no better a reason to choose: an estimate that is many times worse can have it.
    """
    complete = [trial for trial in trials if trial.state == TrialState.COMPLETE]
    return min(complete, key=lambda trial: (not is_consistent(trial), trial.values[0]), default=None)


def is_consistent(trial: FrozenTrial) -> bool:
    """Whether a trial's mean NIS is inside its band; true without a band."""
    return violation(trial) <= 0


def violation(trial: FrozenTrial) -> float:
    """How far a trial's mean NIS is outside its band, in logarithms; at most zero inside, or without a band."""
    return trial.constraints.get(CONSISTENCY, 0.0)


def is_over_budget(trial: FrozenTrial) -> bool:
    """Whether a trial ended because its filter costs too much."""
    return trial.constraints.get(BUDGET, 0.0) > 0
