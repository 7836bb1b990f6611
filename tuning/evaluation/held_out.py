"""Held-out evaluation: a choice and its baselines on seeds that no trial saw, with the bound on these seeds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from filters.consistency.intervals import Interval
from numerics.progress import told
from tuning.evaluation.baselines import (
    ORACLE,
    RULE,
    SCALED,
    TUNED,
    Scaled,
    oracle,
    rule_label,
    rule_of_thumb,
    scaled_default,
)
from tuning.evaluation.evaluate import Evaluation, evaluate, likelihood_gain, score_ratio
from tuning.problems.problem import Problem
from tuning.search.plan import HELD_OUT_SEEDS
from tuning.search.space import Choice


class Comparison(NamedTuple):
    """A choice and its baselines on the same held-out seeds, and the bound on these."""

    untuned: Evaluation  # the rule of thumb
    tuned: Evaluation
    true: Evaluation | None  # the oracle; None where the plant's Q and R are unknown
    bound: np.ndarray  # (n,) bound on the standard error of each state
    seeds: range
    scaled: Evaluation | None = None  # the scaled default; None where there is none
    default: Scaled | None = None  # its factor, or the reason why there is none; None where it was not requested
    kept_ratios: Mapping[str, Interval] | None = None  # given where evaluations are summaries without single runs
    kept_gains: Mapping[str, Interval] | None = None
    rule: str = RULE  # what the rule of thumb is called where people read it: `rule_label`

    @property
    def evaluations(self) -> dict[str, Evaluation]:
        """All evaluations by the names in tables, in the order of the rows."""
        found = {RULE: self.untuned, SCALED: self.scaled, TUNED: self.tuned, ORACLE: self.true}
        return {name: evaluation for name, evaluation in found.items() if evaluation is not None}

    def label(self, name: str) -> str:
        """What a filter of `evaluations` is called where people read it."""
        return self.rule if name == RULE else name

    @property
    def labelled(self) -> dict[str, Evaluation]:
        """`evaluations` by what people read."""
        return {self.label(name): evaluation for name, evaluation in self.evaluations.items()}

    @property
    def ratios(self) -> dict[str, Interval]:
        """Score of the tuned filter over that of each baseline, paired, the most important baseline first."""
        if self.kept_ratios is not None:
            return dict(self.kept_ratios)
        found = self.evaluations
        names = [name for name in (SCALED, RULE, ORACLE) if name in found]
        return {name: score_ratio(self.tuned, found[name]) for name in names}

    @property
    def likelihood_gains(self) -> dict[str, Interval]:
        """Log-likelihood of a run of the tuned filter less that of each baseline; it needs no truth."""
        if self.kept_gains is not None:
            return dict(self.kept_gains)
        found = self.evaluations
        names = [name for name in (SCALED, RULE, ORACLE) if name in found]
        return {name: likelihood_gain(self.tuned, found[name]) for name in names}


def evaluate_held_out(choice: Choice, scenario: Problem, seed: int, count: int = HELD_OUT_SEEDS) -> Comparison:
    """A choice and its baselines on seeds that the study never saw, with the bound on these seeds.

    Args:
        choice: of a study.
        scenario: on what.
        seed: of the study; its training seeds scale the scaled default.
        count: number of held-out seeds; a problem of logs has a fixed number, and ignores it.
    """
    seeds = scenario.held_out_seeds(seed, count)
    data = scenario.data(seeds)
    default = scaled_default(choice.name, scenario, seed)
    choices = (rule_of_thumb(choice.name, scenario), choice, oracle(choice.name, scenario), default.choice)
    done: list[tuple[Choice, Evaluation]] = []
    for one in told("filters on held-out seeds", choices):
        if one is not None and _found(one, done) is None:  # baselines may be the same filter
            done.append((one, evaluate(one.filter(scenario), data, scenario.scale)))
    untuned, tuned, true, scaled = (None if one is None else _found(one, done) for one in choices)
    assert untuned is not None and tuned is not None  # these two choices are never None
    bound, rule = scenario.bound(data), rule_label(scenario)
    return Comparison(untuned, tuned, true, bound, seeds, scaled, default, rule=rule)


def _found(choice: Choice, done: Sequence[tuple[Choice, Evaluation]]) -> Evaluation | None:
    """The evaluation of the same filter, if there is one."""
    return next((evaluation for before, evaluation in done if _same(choice, before)), None)


def _same(a: Choice, b: Choice) -> bool:
    """Whether two choices are the same filter."""
    if a.name != b.name:
        return False
    pairs = (a.model, b.model), (a.numbers, b.numbers)
    return all(
        one.keys() == other.keys() and all(np.array_equal(one[key], other[key]) for key in one)
        for one, other in pairs
    )
