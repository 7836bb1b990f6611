"""The ensemble size: score against N on fresh seeds, and the smallest N that is surely as good as the best."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from filters.consistency.intervals import Interval
from tuning.evaluation.evaluate import Evaluation, evaluate, score_ratio
from tuning.problems.data import Data
from tuning.problems.in_parts import estimates_in_parts
from tuning.problems.problem import Problem
from tuning.search.objectives import nis_violation
from tuning.search.plan import Plan
from tuning.search.space import Choice, size_ladder

SIZE_TOLERANCE = 0.01  # the score of the smallest sufficient ensemble is surely this close to the best


class SizeRow(NamedTuple):
    """How an ensemble of one size does against the best one."""

    size: int
    evaluation: Evaluation  # on the first scenario
    ratio: Interval  # score over the best score on the same seeds, paired; of several scenarios the largest
    outside: float = 0.0  # how far the mean NIS is outside its band, as in `nis_violation`; of several the most


def ensemble_sizes(
    choice: Choice, plan: Plan, training: Sequence[Data], consistent: bool = False
) -> list[SizeRow]:
    """The score of a choice against ensemble size, paired on the same fresh seeds, smallest size first.

    The seeds chose neither Q, R nor N (`seeds.size_seeds`). Where the plan has a budget, no size is above that
    of the choice, which is known to be within it. Without truth there is no score, and no row.

    Args:
        choice: of a study.
        plan: what the study was for.
        training: the plan's training data, on which the mean NIS is held in its band, as in the trials.
        consistent: whether the best one is that of the sizes whose mean NIS is in its band.
    """
    if any(problem.scale is None for problem in plan.scenarios):
        return []
    size = choice.numbers["ensemble_size"]
    sizes = [n for n in sorted({*size_ladder(choice.name), size}) if plan.budget is None or n <= size]
    outside = [_outside(choice.with_size(n), plan, training) if plan.is_constrained else 0.0 for n in sizes]
    tables = [_on(one, fresh, choice, sizes) for one, fresh in zip(plan.scenarios, plan.size_data(), strict=True)]
    among = _counting(outside, consistent)
    columns = [_over_the_best(found, among) for found in tables]
    return [
        SizeRow(n, tables[0][i], max((column[i] for column in columns), key=lambda ratio: ratio.high), outside[i])
        for i, n in enumerate(sizes)
    ]


def sufficient_size(sizes: Sequence[SizeRow], consistent: bool = False) -> int:
    """The smallest size whose 95 % interval of the score over the best one ends below 1.01.

    With several scenarios there may be none that is so good on all of them; then it is the smallest whose interval
    ends within 1 % of where that of the best compromise ends. Where it has to be consistent, sizes whose mean NIS
    is outside its band do not count.
    """
    rows = [sizes[i] for i in _counting([row.outside for row in sizes], consistent)]
    least, limit = min(row.ratio.high for row in rows), 1.0 + SIZE_TOLERANCE
    limit = limit if least < limit else limit * least
    return next(row.size for row in rows if row.ratio.high < limit)


def close_size(choice: Choice, plan: Plan, training: Sequence[Data]) -> int:
    """The smallest ensemble whose estimates are so close to the largest one's that the error hardly grows.

        mean of (m_N - m_L)^2 / P_L over runs, scored steps and states < 1.01^2 - 1

    Where nothing is known of the truth this is what can be told: sampling adds this much to the mean square error,
    in units of the variance that the largest ensemble believes in. The likelihood hardly feels it where R is
    large. Where the plan has a budget, no size is above that of the choice.

    Args:
        choice: of a study.
        plan: what the study was for.
        training: the plan's training data.
    """
    size = choice.numbers["ensemble_size"]
    sizes = [n for n in sorted({*size_ladder(choice.name), size}) if plan.budget is None or n <= size]
    rest, limit = sizes[:-1], (1.0 + SIZE_TOLERANCE) ** 2 - 1.0
    for scenario, data in zip(plan.scenarios, training, strict=True):
        means, variances = _scored(choice.with_size(sizes[-1]), scenario, data)
        likely = np.maximum(variances, np.finfo(float).tiny)
        excess = [((_scored(choice.with_size(n), scenario, data)[0] - means) ** 2 / likely).mean() for n in rest]
        rest = [n for n, one in zip(rest, excess, strict=True) if one < limit]
    return min(rest, default=sizes[-1])


def _scored(choice: Choice, scenario: Problem, data: Data) -> tuple[np.ndarray, np.ndarray]:
    """Means and variances of the scored steps, (B, T, n) each."""
    parts = [found for _, found in estimates_in_parts(choice.filter(scenario), data)]
    means, covs = (
        np.concatenate([getattr(one, name)[:, data.scored] for one in parts]) for name in ("means", "covs")
    )
    return means, np.einsum("bkii->bki", covs)


def _counting(outside: Sequence[float], consistent: bool) -> list[int]:
    """Places of the sizes that count: all, or those whose mean NIS is in its band, wherever there are any."""
    everywhere = list(range(len(outside)))
    return [i for i in everywhere if outside[i] <= 0 or not consistent] or everywhere


def _on(scenario: Problem, data: Data, choice: Choice, sizes: Sequence[int]) -> list[Evaluation]:
    return [evaluate(choice.with_size(n).filter(scenario), data, scenario.scale) for n in sizes]


def _outside(choice: Choice, plan: Plan, training: Sequence[Data]) -> float:
    pairs = zip(plan.scenarios, training, strict=True)
    return max(nis_violation(evaluate(choice.filter(one), data, one.scale)) for one, data in pairs)


def _over_the_best(found: Sequence[Evaluation], among: Sequence[int]) -> list[Interval]:
    best = min((found[i] for i in among), key=lambda evaluation: evaluation.score.value)
    return [score_ratio(evaluation, best) for evaluation in found]
