"""Every second trial of the default sampler is near the best one, so that wide ranges do not slow the search."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from optuna.distributions import BaseDistribution, FloatDistribution, IntDistribution

from thruster_env.core.streams import LOCAL_TRIALS, derived_generator
from tuning.search.plan import Plan

LARGEST = 0.1  # step over the width of a linear range; over a decade of a logarithmic one it is ten times this ...
DECADES = 1.5  # ... and the smallest step is so many powers of ten below
MOVED = 0.5  # probability that a number is moved


def is_local(plan: Plan, number: int) -> bool:
    """Whether the trial after this number is to be near the best: every second one of "tpe" with one objective."""
    return plan.sampler == "tpe" and len(plan.objectives) == 1 and number % 2 == 1


def near(best: Mapping, space: Mapping[str, BaseDistribution], plan: Plan, number: int) -> dict:
    """The parameters of the best trial, some of them changed by normal steps of a common random size.

        log10 x' = log10 x + s n,  n ~ N(0, 1),  log10 s ~ U(-1.5, 0); of a linear range s times a tenth of it

    The same trial number in a study with the same seed gives the same trial.

    Source: Beyer, Schwefel (2002), "Evolution strategies, a comprehensive introduction", Natural Computing 1.
    """
    generator = derived_generator(plan.seed, LOCAL_TRIALS, number)
    size, found = 10.0 ** generator.uniform(-DECADES, 0.0), dict(best)
    names = [name for name in best if isinstance(space.get(name), FloatDistribution | IntDistribution)]
    moved = generator.random(len(names)) < MOVED
    if names and not moved.any():
        moved[generator.integers(len(names))] = True
    for name, step in zip(names, np.where(moved, size * generator.standard_normal(len(names)), 0.0), strict=True):
        one, value = space[name], best[name]
        assert isinstance(one, FloatDistribution | IntDistribution)
        if step == 0.0:
            continue
        value = value * 10.0**step if one.log else value + LARGEST * step * (one.high - one.low)
        value = float(np.clip(value, one.low, one.high))
        found[name] = round(value) if isinstance(one, IntDistribution) else value
    return found
