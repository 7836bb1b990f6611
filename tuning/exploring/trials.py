"""A study of a bench's filter, trial by trial."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple

from optuna.trial import TrialState

from tuning.search.plan import Plan
from tuning.search.space import Choice
from tuning.search.study import FINISHED, finished_trials, open_study, quiet_optuna, run_trials


class Trial(NamedTuple):
    """What a trial of a study tried, and what came of it."""

    values: Mapping[str, float]  # by knob
    score: float  # the study's objective; of a pruned trial that of the seeds that it came to
    pruned: bool = False


def trials_of(plan: Plan, start: Choice, trials: int) -> Iterator[Trial]:
    """Run a study in memory, and yield each trial as soon as it is finished; it ends where the iterator is closed.

    Args:
        plan: of the study.
        start: the first trial.
        trials: how many it shall have.
    """
    quiet_optuna()
    study, data = open_study("explore", plan, None, start), plan.training_data()
    finished: list[int] = []  # of the present round, which ends after one trial
    while finished_trials(study) < trials:
        finished.clear()
        if run_trials(study, plan, data, trials, lambda _, count: finished.append(count), lambda: bool(finished)):
            return
        last = study.get_trials(deepcopy=False, states=FINISHED)[-1]
        pruned = last.state == TrialState.PRUNED
        seen = list(last.intermediate_values.values())
        score = sum(seen) / len(seen) if pruned and seen else last.values[0]
        yield Trial(dict(last.params), score, pruned)
