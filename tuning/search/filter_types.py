"""The report of a study over several filter types on each type."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from optuna.trial import FrozenTrial, TrialState

from tuning.search.cost import COST
from tuning.search.objectives import reported
from tuning.search.outcome import best_trial, is_consistent, is_over_budget
from tuning.search.space import FILTER_TYPE


class TypeResult(NamedTuple):
    """The results of a filter type in a study."""

    name: str
    trials: int  # finished ones
    pruned: int  # for their errors ...
    over_budget: int  # ... and for their cost
    value: float | None  # first objective of its best trial; None if none is complete
    consistent: bool  # whether that trial's mean NIS (normalised innovation squared) is within its band
    microseconds: float | None  # us/step of that trial or, if none is complete, of the cheapest one

    def best(self, objective: str) -> str:
        """The first objective of the best trial in words; a star if its mean NIS is outside its band."""
        if self.value is None:
            return ""
        return f"{reported(objective, self.value):.4g}{'' if self.consistent else '*'}"


def filter_types_tried(trials: Sequence[FrozenTrial]) -> list[TypeResult]:
    """The filter types that finished trials chose, the best first; empty for a study of one type."""
    by_type: dict[str, list[FrozenTrial]] = {}
    for trial in trials:
        if FILTER_TYPE in trial.params and trial.state in (TrialState.COMPLETE, TrialState.PRUNED):
            by_type.setdefault(trial.params[FILTER_TYPE], []).append(trial)
    rows = [_row(name, some) for name, some in by_type.items()]
    return sorted(rows, key=lambda row: (row.value is None, not row.consistent, row.value or 0.0))


def filter_types_running(trials: Sequence[FrozenTrial]) -> list[str]:
    """The filter types of the running trials, in alphabetical order; empty in a study of one type."""
    running = (trial for trial in trials if trial.state == TrialState.RUNNING)
    return sorted({trial.params[FILTER_TYPE] for trial in running if FILTER_TYPE in trial.params})


def trials_of_type(trials: Sequence[FrozenTrial], name: str) -> list[FrozenTrial]:
    """Trials that chose a filter type; all of them in a study of one type."""
    return [trial for trial in trials if trial.params.get(FILTER_TYPE, name) == name]


def _row(name: str, trials: list[FrozenTrial]) -> TypeResult:
    best, over = best_trial(trials), sum(map(is_over_budget, trials))
    costs = [trial.user_attrs[COST] for trial in ([best] if best else trials) if COST in trial.user_attrs]
    return TypeResult(
        name,
        len(trials),
        sum(trial.state == TrialState.PRUNED for trial in trials) - over,
        over,
        None if best is None else best.values[0],
        best is not None and is_consistent(best),
        min(costs, default=None),
    )
