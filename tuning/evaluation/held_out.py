"""Held-out evaluation: a choice and its baselines on seeds that no trial saw, with the bound on these seeds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from filters.consistency.intervals import Interval
from thruster_env.core.progress import with_progress
from tuning.evaluation.baselines import (
    BY_IMPORTANCE,
    GIVEN,
    NOISE,
    ORACLE,
    RULE,
    SCALED,
    TUNED,
    Scaled,
    baseline_size,
    baselines,
    rule_label,
    same_filter,
    scaled_default,
)
from tuning.evaluation.evaluate import (
    NOTHING,
    Evaluation,
    evaluate,
    likelihood_gain,
    score_ratio,
)
from tuning.evaluation.outliers import uneven_nis
from tuning.evaluation.regression import gain_over_regression
from tuning.problems.check import data_of
from tuning.problems.problem import Problem
from tuning.search.forgetting import time_constants_on, with_oracle_and_advice
from tuning.search.plan import HELD_OUT_SEEDS, TRAINING_SEEDS
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
    stored_ratios: Mapping[str, Interval] | None = (
        None  # given where evaluations are summaries without single runs
    )
    stored_gains: Mapping[str, Interval] | None = None
    rule: str = RULE  # GIVEN where the rule of thumb is what was given, and so no row of its own: `rule_label`
    given: Evaluation | None = None  # what the model came with; None where nobody gave anything
    noise: Evaluation | None = None  # noise estimation; None where there is none
    lacks_ranges: bool = False  # whether the rule of thumb has the model's own Q: `Problem.lacks_ranges`
    over_regression: Interval = NOTHING  # without truth: `regression.gain_over_regression` of the tuned filter

    @property
    def evaluations(self) -> dict[str, Evaluation]:
        """All evaluations by the names in tables, in the order of the rows."""
        by_name = {GIVEN: self.given, RULE: self.untuned, SCALED: self.scaled, NOISE: self.noise}
        by_name |= {TUNED: self.tuned, ORACLE: self.true}
        if self.rule == GIVEN:
            del by_name[RULE]
        return {name: evaluation for name, evaluation in by_name.items() if evaluation is not None}

    @property
    def baselines(self) -> tuple[str, ...]:
        """Names of the existing baselines, the most important one first, those with the plant's Q and R last."""
        names = [name for name in BY_IMPORTANCE if name in self.evaluations]
        return tuple(sorted(names, key=lambda name: name == ORACLE or (name == GIVEN and self.given_is_oracle)))

    @property
    def given_is_oracle(self) -> bool:
        """Whether the model came with the plant's own Q and R, which tuning does not compete with."""
        if self.given is None or self.true is None or self.rule == GIVEN:
            return False
        return (self.given.score, self.given.nis) == (self.true.score, self.true.nis)

    @property
    def ratios(self) -> dict[str, Interval]:
        """Score of the tuned filter over that of each baseline, paired, the most important baseline first."""
        if self.stored_ratios is not None:
            return dict(self.stored_ratios)
        evaluations = self.evaluations
        return {name: score_ratio(self.tuned, evaluations[name]) for name in self.baselines}

    @property
    def likelihood_gains(self) -> dict[str, Interval]:
        """Log-likelihood of a run of the tuned filter minus that of each baseline; it needs no truth."""
        if self.stored_gains is not None:
            return dict(self.stored_gains)
        evaluations = self.evaluations
        return {name: likelihood_gain(self.tuned, evaluations[name]) for name in self.baselines}


def evaluate_held_out(choice: Choice, scenario: Problem, seed: int, count: int = HELD_OUT_SEEDS) -> Comparison:
    """A choice and its baselines on seeds that the study never saw, with the bound on these seeds.

    Baselines of an ensemble filter have as many members as the choice, or more: `baseline_size`.

    Args:
        choice: of a study.
        scenario: the problem.
        seed: of the study; its training seeds scale the scaled default.
        count: number of held-out seeds; a problem of logs has a fixed number, and ignores it.
    """
    seeds = scenario.held_out_seeds(seed, count)
    data = data_of(scenario, seeds)
    size = baseline_size(choice)
    default = scaled_default(choice.name, scenario, seed, size)
    known = baselines(choice.name, scenario, seed, default, size)
    choices = {
        "untuned": known.get(RULE, known.get(GIVEN)),  # which may be the same
        "tuned": choice,
        "true": known.get(ORACLE),
        "scaled": known.get(SCALED),
        "given": known.get(GIVEN),
        "noise": known.get(NOISE),
    }
    done: list[tuple[Choice, Evaluation]] = []
    for candidate in with_progress("filters on held-out seeds", list(choices.values())):
        if candidate is not None and _evaluation_in(candidate, done) is None:  # baselines may be the same filter
            done.append((candidate, evaluate(candidate.filter(scenario), data, scenario.scale)))
    evaluations = {
        role: None if choice is None else _evaluation_in(choice, done) for role, choice in choices.items()
    }
    untuned, tuned = evaluations.pop("untuned"), evaluations.pop("tuned")
    assert untuned is not None and tuned is not None  # these two choices are never None
    constants = time_constants_on(choice.filter(scenario), scenario, seed)
    if constants is not None:
        constants = with_oracle_and_advice(constants, choice, scenario, seed)
    uneven = uneven_nis(choice.filter(scenario), scenario, seed)
    tuned = tuned._replace(time_constants=constants, uneven=uneven)
    bound, rule, lacks = scenario.bound(data), rule_label(scenario), scenario.lacks_ranges
    over_regression = NOTHING
    if data.states is None:
        training = data_of(scenario, scenario.training_seeds(seed, TRAINING_SEEDS))
        over_regression = gain_over_regression(scenario.model(), tuned, training, data)
    return Comparison(
        untuned,
        tuned,
        evaluations["true"],
        bound,
        seeds,
        evaluations["scaled"],
        default,
        rule=rule,
        given=evaluations["given"],
        noise=evaluations["noise"],
        lacks_ranges=lacks,
        over_regression=over_regression,
    )


def _evaluation_in(choice: Choice, done: Sequence[tuple[Choice, Evaluation]]) -> Evaluation | None:
    """The evaluation of the same filter, if there is one."""
    return next((evaluation for before, evaluation in done if same_filter(choice, before)), None)
