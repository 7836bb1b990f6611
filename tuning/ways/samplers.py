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


def sample(sampler: str, objective: str | None = None) -> Callable[[Task], None]:
    """The way that minimises an objective, by default the task's, over trials of a sampler, from the start on.

    Every trial has the same runs, so that the differences between trials are not those of noise.
    """

    def follow(task: Task) -> None:
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
            value = task.value(choice, objective)
            study.tell(trial, value)
            if value < least:
                least = value
                task.keep(choice)

    return follow
