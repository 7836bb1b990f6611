"""The ensemble size: score against N on fresh seeds, and the smallest N that is as good as the best."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from filters.bounds import ALL_UP_TO
from filters.consistency.nees import Interval
from thruster_env.core.checks import with_progress
from tuning.evaluation.evaluate import Evaluation, evaluate, resampled_ratios, score_ratio, values_of
from tuning.problems.data import Data
from tuning.problems.problem import Problem
from tuning.search.parameters import size_ladder
from tuning.search.plan import MOST_PRICE, SIZE_SEEDS, Plan, nis_violation
from tuning.search.space import Choice

FEW = 8  # of the fresh seeds, on which all sizes of a large model are compared first
SURE = 0.0005  # quantile of the resamples by which a size is left out after these seeds
SIZE_TOLERANCE = 0.01  # the score of the smallest sufficient ensemble is this close to the best (95 %)


class SizeRow(NamedTuple):
    """An ensemble of one size compared with the best one, on the seeds on which it was run."""

    size: int
    evaluation: Evaluation  # on the first scenario
    ratio: Interval  # score over the best score on the same seeds, paired; the largest of several scenarios
    outside: float = 0.0  # `nis_violation`; the largest of several scenarios
    seeds: int = SIZE_SEEDS  # on which it was run


def ensemble_sizes(
    choice: Choice, plan: Plan, training: Sequence[Data], consistent: bool = False
) -> list[SizeRow]:
    """The score of a choice against ensemble size, paired on the same fresh seeds, smallest size first.

    Neither Q nor R nor N was chosen on these seeds (`seeds.size_seeds`). If the plan has a budget, no size is
    above that of the choice, which is within it. Without truth there is no score, and no row. For
    models of more than twelve states the sizes are first compared on a few of the seeds: see `few_seeds_first`.

    Args:
        choice: the choice of a study.
        plan: the plan of the study.
        training: the plan's training data, on which the mean NIS has to be within its band, as in the trials.
        consistent: whether the best size must have its mean NIS in the band.
    """
    if any(problem.scale is None for problem in plan.scenarios):
        return []
    size = choice.numbers["ensemble_size"]
    sizes = [n for n in sorted({*size_ladder(choice.name), size}) if plan.budget is None or n <= size]
    if max(problem.model().n for problem in plan.scenarios) > ALL_UP_TO:
        return few_seeds_first(choice, plan, training, sizes, consistent)
    outside = [_outside(choice.with_size(n), plan, training) if plan.is_constrained else 0.0 for n in sizes]
    tables = [
        _on(problem, fresh, choice, sizes) for problem, fresh in zip(plan.scenarios, plan.size_data(), strict=True)
    ]
    scores = np.mean([[evaluation.score.value for evaluation in table] for table in tables], axis=0).tolist()
    among = _counting(outside, consistent, scores)
    columns = [_over_the_best(table, among) for table in tables]
    count = len(plan.size_data()[0].seeds)
    return [
        SizeRow(n, tables[0][i], _worst(column[i] for column in columns), outside[i], count)
        for i, n in enumerate(sizes)
    ]


def few_seeds_first(
    choice: Choice, plan: Plan, training: Sequence[Data], sizes: Sequence[int], consistent: bool
) -> list[SizeRow]:
    """The same for expensive steps: a size is not run on all seeds if a few seeds show that it is too small.

    All sizes are run on the first eight seeds. The one with the lowest score there, in each scenario, is the best
    one, and is run on all seeds; so are the others, smallest first, until one is sufficient. A size is dropped if
    its score on the first seeds is more than 1 % above the best, by the lower end of a 99.9 % interval: an interim
    analysis needs this level so that the final interval keeps its 95 % (Peto's rule). No size is accepted early,
    because a small ensemble may fail only in rare runs. The mean NIS is that of the first fresh seeds; for sizes
    run on all seeds it is that of the training data.

    Source: Peto et al. (1976), "Design and analysis of randomized clinical trials requiring prolonged observation
    of each patient", British J. Cancer 34, 585-612.
    """
    fresh = plan.size_data()
    few = [part.slice(0, FEW) for part in fresh]

    def on(data: Sequence[Data], n: int) -> list[Evaluation]:
        pairs = zip(plan.scenarios, data, strict=True)
        return [evaluate(choice.with_size(n).filter(problem), part, problem.scale) for problem, part in pairs]

    early = [on(few, n) for n in with_progress("N", sizes)]

    def on_all(i: int) -> list[Evaluation]:
        return early[i] if all(len(part.seeds) <= FEW for part in fresh) else on(fresh, sizes[i])

    outside = [max(map(nis_violation, evaluations)) if plan.is_constrained else 0.0 for evaluations in early]
    trained: set[int] = set()

    def best_ones() -> list[int]:
        among = _counting(outside, consistent, [_score(evaluations) for evaluations in early])
        return [min(among, key=lambda i: early[i][k].score.value) for k in range(len(fresh))]

    def train(i: int) -> None:
        if i not in trained and plan.is_constrained:
            outside[i] = _outside(choice.with_size(sizes[i]), plan, training)
        trained.add(i)

    while not trained.issuperset(best_ones()):
        for i in set(best_ones()):
            train(i)
    best = best_ones()
    on_all_seeds = {i: on_all(i) for i in with_progress("best N on all seeds", sorted(set(best)))}
    hopeful = [i for i in range(len(sizes)) if not _surely_worse(early[i], [early[b] for b in best])]
    for i in with_progress("smallest N on all seeds", hopeful):
        if i not in on_all_seeds:
            train(i)
            on_all_seeds[i] = on_all(i)
        ends = [ratio[i].high for ratio in _ratios_of(on_all_seeds, _eligible(on_all_seeds, outside, consistent))]
        if i in _eligible(on_all_seeds, outside, consistent) and max(ends) < 1.0 + SIZE_TOLERANCE:
            break
    over = _ratios_of(on_all_seeds, _eligible(on_all_seeds, outside, consistent))
    rows = []
    for i, n in enumerate(sizes):
        if i in on_all_seeds:
            ratio = _worst(ratios[i] for ratios in over)
            rows.append(SizeRow(n, on_all_seeds[i][0], ratio, outside[i], len(fresh[0].seeds)))
            continue
        ratios = (
            score_ratio(evaluation, early[b][k])
            for k, (evaluation, b) in enumerate(zip(early[i], best, strict=True))
        )
        rows.append(SizeRow(n, early[i][0], _worst(ratios), outside[i], len(few[0].seeds)))
    return rows


def _ratios_of(results: Mapping[int, Sequence[Evaluation]], among: Sequence[int]) -> list[dict[int, Interval]]:
    """For each scenario, scores of the sizes that were run on all seeds over the best of the eligible ones."""
    indices = list(results)
    columns = zip(*results.values(), strict=True)
    intervals = [_over_the_best(column, [indices.index(i) for i in among]) for column in columns]
    return [dict(zip(indices, ratios, strict=True)) for ratios in intervals]


def _eligible(
    results: Mapping[int, Sequence[Evaluation]], outside: Sequence[float], consistent: bool
) -> list[int]:
    indices, scores = list(results), [_score(evaluations) for evaluations in results.values()]
    return [indices[i] for i in _counting([outside[i] for i in indices], consistent, scores)]


def _score(evaluations: Sequence[Evaluation]) -> float:
    return float(np.mean([evaluation.score.value for evaluation in evaluations]))


def _surely_worse(evaluations: Sequence[Evaluation], best: Sequence[Sequence[Evaluation]]) -> bool:
    """Whether the score is significantly more than 1 % above the best on some scenario, after a few seeds."""
    pairs = [(evaluation, best[k][k]) for k, evaluation in enumerate(evaluations)]
    return any(np.quantile(resampled_ratios(*pair), SURE) > 1.0 + SIZE_TOLERANCE for pair in pairs)


def _worst(ratios: Iterable[Interval]) -> Interval:
    return max(ratios, key=lambda ratio: ratio.high)


def sufficient_size(sizes: Sequence[SizeRow], consistent: bool = False) -> int:
    """The smallest size whose 95 % interval of the score over the best one ends below 1.01.

    With several scenarios there may be none for all of them; then it is the smallest whose interval
    ends within 1 % of that of the best compromise. If it has to be consistent, sizes whose mean NIS
    is outside its band are not eligible.
    """
    scores = [row.ratio.value for row in sizes]
    rows = [sizes[i] for i in _counting([row.outside for row in sizes], consistent, scores)]
    least, limit = min(row.ratio.high for row in rows), 1.0 + SIZE_TOLERANCE
    limit = limit if least < limit else limit * least
    return next(row.size for row in rows if row.ratio.high < limit)


def _counting(outside: Sequence[float], consistent: bool, scores: Sequence[float]) -> list[int]:
    """Indices of the eligible sizes: those with a mean NIS within its band, if required and if any has it.

    All of them, where the best score of these is more than 5 % above the best of all: that is too much to pay.
    """
    everywhere = list(range(len(outside)))
    inside = [i for i in everywhere if outside[i] <= 0]
    if not consistent or not inside or min(scores[i] for i in inside) > (1.0 + MOST_PRICE) * min(scores):
        return everywhere
    return inside


def left_out(rows: Sequence[SizeRow], chosen: int) -> list[int]:
    """Sizes that were not eligible because of their mean NIS, if that of the chosen one is in its band."""
    outside = {row.size: row.outside for row in rows}
    return [] if outside.get(chosen, 1.0) > 0 else [size for size, distance in outside.items() if distance > 0]


def _on(scenario: Problem, data: Data, choice: Choice, sizes: Sequence[int]) -> list[Evaluation]:
    return [
        evaluate(choice.with_size(n).filter(scenario), data, scenario.scale) for n in with_progress("N", sizes)
    ]


def _outside(choice: Choice, plan: Plan, training: Sequence[Data]) -> float:
    """The mean NIS of a choice outside its band on the training data; the largest of several scenarios."""
    pairs = zip(plan.scenarios, training, strict=True)
    return max(nis_violation(values_of(choice.filter(problem), data, problem.scale)) for problem, data in pairs)


def _over_the_best(evaluations: Sequence[Evaluation], among: Sequence[int]) -> list[Interval]:
    best = min((evaluations[i] for i in among), key=lambda evaluation: evaluation.score.value)
    return [score_ratio(evaluation, best) for evaluation in evaluations]
