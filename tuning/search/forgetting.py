"""Choices whose Q is raised so that the filter forgets in time."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from filters.consistency.time_constants import Path, forgetting_noise, slopes_along
from filters.registry import make_filter
from filters.tuned_file import NOISE, PRIOR
from tuning.problems.assumed import rows_argument
from tuning.problems.check import data_of
from tuning.problems.data import runs_of
from tuning.problems.problem import Problem
from tuning.search.space import Choice


def forgetting(choice: Choice, problems: Sequence[Problem], seeds: Sequence[Any], seconds: float) -> Choice:
    """The choice with the least Q, from its own up, by which no time constant on problems exceeds some seconds.

    Args:
        choice: of a filter with a covariance.
        problems: of models of one size; the path of each is that of an extended filter with the untuned Q and R.
        seeds: training seeds of each problem.
        seconds: the longest time constant that is allowed [s].

    Raises:
        ValueError: if no Q is enough.
    """
    for problem, some in zip(problems, seeds, strict=True):
        own = {name: value for name, value in choice.model.items() if name not in (*NOISE, PRIOR)}
        path = _path(choice.name, problem, some, tuple(sorted(own.items())))
        model = problem.model(**choice.model)
        if path is None or problem.dt is None:
            continue
        q = forgetting_noise(path, model, seconds, problem.dt)
        if not np.array_equal(q, model.process_noise_cov):
            choice = choice._replace(model={**choice.model, NOISE[0]: rows_argument(q)})
    return choice


@lru_cache(maxsize=64)
def _path(name: str, problem: Problem, seeds: Any, own: tuple) -> Path | None:
    """Slopes of the model that a filter of this name assumes, along estimates with the untuned Q and R."""
    untuned = problem.model(**problem.untuned)
    model = problem.model(**dict(own)) if own else untuned
    model = model.replace(**{noise: getattr(untuned, noise) for noise in NOISE})
    used = make_filter("ekf", make_filter(name, model).kernel_model)
    return slopes_along(used, runs_of(data_of(problem, seeds)))
