"""Ways that ask one of Optuna's samplers for trials, and know of an objective nothing but its values."""

from __future__ import annotations

import math
from collections.abc import Callable

import optuna
from optuna.distributions import BaseDistribution

from tuning.search.quiet import quiet_optuna
from tuning.search.samplers import make_sampler
from tuning.ways.task import Task

MOST_TRIALS = 10_000
SLOWER = 10  # steps from one measurement to the next at the second sample time: 0.1 s and 1 s in the source


def sample(sampler: str, objective: str | None = None, slower: int | None = None) -> Callable[[Task], None]:
    """The way that minimises an objective, by default the task's, over trials of a sampler, from the start on.

    Every trial has the same runs, so that the differences between trials are not those of noise. With a second
    sample time, slower by so many steps, each trial is measured at both, and the larger value counts.
    """

    def follow(task: Task) -> None:
        rates = [task.data] if slower is None else [task.data, [one.every(slower) for one in task.data]]
        space: dict[str, BaseDistribution] = {one.name: one.distribution for one in task.searched}
        with task.uncounted(), quiet_optuna():  # packages are loaded
            made = make_sampler(sampler, task.seed, 0, space)
            study = optuna.create_study(sampler=made)
        given = dict(zip(space, task.values_of(task.start, task.searched), strict=True))
        study.enqueue_trial({one.name: min(max(given[one.name], one.low), one.high) for one in task.searched})
        least = math.inf
        for _ in range(MOST_TRIALS):
            with quiet_optuna():
                trial = study.ask(space)
            choice = task.with_values([trial.params[name] for name in space], task.searched)
            value = max(task.value(choice, objective, data) for data in rates)
            study.tell(trial, value)
            if value < least:
                least = value
                task.keep(choice)

    return follow
