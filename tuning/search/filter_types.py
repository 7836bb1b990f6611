"""What a study over several kinds of filters says of each kind."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from optuna.trial import FrozenTrial, TrialState

from tuning.search.cost import COST
from tuning.search.outcome import best_trial, is_consistent, is_over_budget
from tuning.search.space import KIND


class Kind(NamedTuple):
    """How a kind of filter did in a study."""

    name: str
    trials: int  # finished ones
    pruned: int  # that ended early for their errors ...
    over_budget: int  # ... and for their cost
    value: float | None  # first objective of its best trial; None if none is complete
    consistent: bool  # whether that trial's mean NIS is in its band
    microseconds: float | None  # what a step of that trial costs or, if none is complete, of the cheapest one


def kinds_tried(trials: Sequence[FrozenTrial]) -> list[Kind]:
    """The kinds of filters that finished trials chose, the best first; empty for a study of one kind."""
    by_kind: dict[str, list[FrozenTrial]] = {}
    for trial in trials:
        if KIND in trial.params and trial.state in (TrialState.COMPLETE, TrialState.PRUNED):
            by_kind.setdefault(trial.params[KIND], []).append(trial)
    rows = [_kind(name, some) for name, some in by_kind.items()]
    return sorted(rows, key=lambda row: (row.value is None, not row.consistent, row.value or 0.0))


def kinds_running(trials: Sequence[FrozenTrial]) -> list[str]:
    """The kinds of filters that are under trial, in alphabetical order; empty in a study of one kind."""
    running = (trial for trial in trials if trial.state == TrialState.RUNNING)
    return sorted({trial.params[KIND] for trial in running if KIND in trial.params})


def trials_of_kind(trials: Sequence[FrozenTrial], name: str) -> list[FrozenTrial]:
    """Trials that chose a kind; all of them in a study of one kind."""
    return [trial for trial in trials if trial.params.get(KIND, name) == name]


def _kind(name: str, trials: list[FrozenTrial]) -> Kind:
    best, over = best_trial(trials), sum(map(is_over_budget, trials))
    costs = [trial.user_attrs[COST] for trial in ([best] if best else trials) if COST in trial.user_attrs]
    return Kind(
        name,
        len(trials),
        sum(trial.state == TrialState.PRUNED for trial in trials) - over,
        over,
        None if best is None else best.values[0],
        best is not None and is_consistent(best),
        min(costs, default=None),
    )
