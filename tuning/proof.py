"""What a choice is worth: against ensemble size on the training seeds, and on seeds that no trial saw."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from tuning.evaluate import Evaluation, evaluate, score_ratio
from tuning.objectives import nis_violation
from tuning.plan import HELD_OUT_SEEDS, Plan
from tuning.scenarios import Data, Scenario, held_out_seeds
from tuning.space import Choice, size_ladder, true_choice, untuned_choice

SIZE_TOLERANCE = 0.01  # the tuned ensemble is the smallest whose paired score is this close to the best


class Comparison(NamedTuple):
    """Three choices on the same held-out seeds, and the bound on these."""

    untuned: Evaluation
    tuned: Evaluation
    true: Evaluation
    bound: np.ndarray  # (n,) bound on the standard error of each state
    seeds: range


class SizeRow(NamedTuple):
    """How an ensemble of one size does against the best one."""

    size: int
    evaluation: Evaluation
    ratio: float  # score over the best score on the same seeds
    outside: float = 0.0  # how far the mean NIS is outside its band, as in `nis_violation`; of several the most


def ensemble_sizes(choice: Choice, plan: Plan, data: Sequence[Data]) -> list[SizeRow]:
    """The score of a choice against ensemble size, paired on the same seeds, smallest size first.

    With several scenarios the ratio is the largest of them: a size that suffices for all. Where the plan has a
    budget, no size is above that of the choice, which is known to be within it.
    """
    size = choice.numbers["ensemble_size"]
    sizes = [n for n in sorted({*size_ladder(choice.name), size}) if plan.budget is None or n <= size]
    pairs = list(zip(plan.scenarios, data, strict=True))
    tables = [[evaluate(choice.with_size(n).filter(one), part, one.scale) for n in sizes] for one, part in pairs]
    best = [min(evaluations, key=lambda e: e.score.value) for evaluations in tables]
    ratios = [[score_ratio(e, least).value for e in found] for found, least in zip(tables, best, strict=True)]
    outside = [[nis_violation(e) if plan.is_constrained else 0.0 for e in found] for found in tables]
    return [
        SizeRow(n, tables[0][i], max(column[i] for column in ratios), max(column[i] for column in outside))
        for i, n in enumerate(sizes)
    ]


def sufficient_size(sizes: Sequence[SizeRow], consistent: bool = False) -> int:
    """The smallest size that is as good as the best one; with several scenarios no size is best on all of them.

    Where it has to be consistent, sizes whose mean NIS is outside its band do not count.
    """
    sizes = [row for row in sizes if row.outside <= 0 or not consistent] or sizes
    least = min(row.ratio for row in sizes)
    return next(row.size for row in sizes if row.ratio <= (1.0 + SIZE_TOLERANCE) * least)


def prove(choice: Choice, scenario: Scenario, seed: int, count: int = HELD_OUT_SEEDS) -> Comparison:
    """Untuned, tuned and true filter on seeds that the study never saw, with the bound on these seeds."""
    seeds = held_out_seeds(seed, count)
    data = scenario.data(seeds)
    choices = (untuned_choice(choice.name, scenario), choice, true_choice(choice.name, scenario))
    evaluations = [evaluate(c.filter(scenario), data, scenario.scale) for c in choices]
    return Comparison(*evaluations, bound=scenario.bound(data), seeds=seeds)
