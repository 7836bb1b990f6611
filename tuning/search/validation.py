"""The choice at the end of a study: the best trials and the baselines meet on validation seeds."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from math import isfinite, isnan, nan
from statistics import geometric_mean
from typing import NamedTuple

import numpy as np

from filters.consistency.nees import Interval, slightly
from filters.registry import filter_type
from filters.tuned_file import NOISE as NOISE_ARGUMENTS
from tuning.evaluation.baselines import (
    FULL_Q,
    FULL_QR,
    GIVEN,
    RULE,
    SCALED,
    baseline_size,
    competing_baselines,
    full_noise,
    same_filter,
)
from tuning.evaluation.evaluate import is_beyond
from tuning.problems.data import Data
from tuning.search.measures import (
    LEVEL,
    Measured,
    is_better,
    log_score_gain,
    logs_with_loss,
    measured,
    over,
    signed_rank,
)
from tuning.search.parameters import ensemble_sizes_of, model_parameters, obeying
from tuning.search.plan import LARGEST, MOST_PRICE, MSE, NIS_BAND, OUTPUT, PROPER, SCORE, Plan
from tuning.search.space import Choice
from tuning.search.trials import cost_of

BY_CONSISTENCY = 2  # consistent trials that meet the baselines, the best ones
VALIDATED = (SCORE, "thrust", MSE, *PROPER)  # objectives, beside those of outputs, that each run has
NEES = ("nees", "state_nees")  # fields of `Met` that need truth
EQUAL = 1e-4  # of the score, within which two filters are surely one in error, and consistency decides
FAILS = 2.0  # mean NIS of a run over the number of channels, beyond which a filter fails there ...
RARE = 1e-4  # ... if a consistent one has it more seldom than this
WORST = 3  # runs in which a filter fails are named


class Met(NamedTuple):
    """One filter on the validation seeds."""

    name: str  # of a baseline, or "trial 18" with trials numbered from 1
    choice: Choice
    value: float  # the study's objective: the score, or the negative log-likelihood of a run
    over: Interval  # over the best baseline, paired: ratio of errors, or difference of log-likelihoods
    proper: float  # log score of the state a step; without truth log-likelihood of a run; more is better
    nis: float  # the mean NIS over the number of channels; of several problems the one farthest from 1
    consistent: bool  # whether it is in its band on all problems
    nees: float = nan  # mean NEES over the number of states, of several problems the one farthest from 1
    state_nees: float = nan  # mean e_i^2 / P_ii of the scored state where it is farthest from 1
    chance: float = 1.0  # p-value of signed ranks: that it is no better than the best baseline in most runs
    worse_in: tuple[str, ...] = ()  # logs in which it is worse than that by more than a standard error
    raised: bool = False  # whether it is a baseline whose Q was raised for it to forget in time


class Failure(NamedTuple):
    """A run in which a baseline fails: its mean NIS over the number of channels, and that of the best trial."""

    run: str  # in words: "seed 7", or the log and the times of a block
    nis: float
    candidate: float


class Validation(NamedTuple):
    """The meeting of the best trials and the baselines, and what came of it."""

    seeds: tuple[int, ...]  # of the first problem; of logs numbers of blocks
    has_own_seeds: bool  # whether no trial saw them: a short log has no blocks to set aside
    met: tuple[Met, ...]  # the baselines first
    baseline: str  # name of the best baseline
    candidate: str  # name of the best trial; that of the baseline where no trial is another filter
    chosen: str  # the filter that a study gives
    price: float | None  # error of the best consistent trial over that of the best one, less 1
    full: Met | None = None  # noise estimation's full Q where it is better than the choice of own parameters
    by_error: str = ""  # which of the two the objective alone would choose; empty where the log score has no say
    tested: str = ""  # the baseline whose failures these are: what was given, where there is any
    failures: tuple[Failure, ...] = ()  # the worst of them, worst first
    failed: int = 0  # number of runs in which it fails ...
    runs: int = 0  # ... of so many, training and validation

    @property
    def gave_way(self) -> bool:
        """Whether the trials gave way to a baseline."""
        return self.chosen != self.candidate or self.candidate == self.baseline

    def named(self, name: str) -> Met:
        """One of those that met."""
        return next(met for met in self.met if met.name == name)

    @property
    def ratio(self) -> Interval:
        """The best trial over the best baseline: ratio of errors, or difference of negative log-likelihoods."""
        return self.named(self.candidate).over


def is_validated(plan: Plan) -> bool:
    """Whether the runs of a plan's objective can be compared with those of baselines, filter by filter."""
    first = plan.objectives[0]
    return len(plan.objectives) == 1 and (first in VALIDATED or first.startswith(OUTPUT))


def validate(
    plan: Plan, finalists: Mapping[str, Choice], training: Sequence[Data], *, rescales: bool = True
) -> Validation | None:
    """Let the best trials and the baselines meet, and choose.

    The best baseline is the one with the least objective; numbers that the user gave remain it until another one
    passes the test of trials below. The rule of thumb and the scaled default, which are not fitted to the training
    runs, may pass it there if they are better on the validation runs, too: few of these hardly tell two filters
    apart. The best trial is the one with the best log score of the true states among
    those within 5 % of the least error; without truth it is the one with the least objective among the consistent
    ones, if these cost at most 5 % more than the best of all. A trial can be taken if

    - it is significantly better than the best baseline, by Student's 95 % interval of the jackknife, or by
      Wilcoxon's signed ranks of the runs if it is also better as a whole: one run in which a baseline fails makes
      the interval so wide that it protects the baseline; or it alone is consistent and surely loses less than
      1e-4 of the error;
    - and in no log it is worse by more than a standard error: the mean over logs may be that of one, and the next
      log like another.

    If the best trial cannot be taken, the best of those that can is; if there is none, the best baseline. At last
    the log score may decide for another: `_by_log_score`. The level is not divided by the number of trials: a
    trial that is taken by chance is one that hardly differs, and held out it is significantly worse in less than
    1 % of studies, but where failures are rare (docs/appendix/tuning.md).

    Args:
        plan: of the study.
        finalists: the filters that meet the baselines, by name, with the ensemble size that they end with: of
            `finalists_of`, or the answer of a method. Baselines have at least the size of the first one.
        training: its training data, by which the cost of a baseline is measured.
        rescales: whether the first two also compete with Q and R times their mean NEES over n.

    Returns:
        The meeting; None for a plan whose objective cannot be compared, without finalists, and if no baseline is
        within the budget.
    """
    if not is_validated(plan) or not finalists:
        return None
    first = next(iter(finalists.values()))
    baselines = _baselines_of(plan, first, training)
    if not baselines:  # all are over the budget
        return None
    before = {name: plan.forgetting(choice) for name, choice in baselines.items()}
    finalists = {
        name: choice
        for name, choice in finalists.items()
        if not any(same_filter(choice, other) for other in before.values())
    }
    if rescales:
        finalists |= _rescaled(finalists, plan, training)
    everyone, data = {**before, **finalists}, plan.validation_data()
    results = {name: measured(choice, plan, data) for name, choice in everyone.items()}
    has_own_seeds = not set(data[0].seeds) & set(training[0].seeds)
    on_training = {}
    if GIVEN in before and has_own_seeds:
        unfitted = [name for name in (GIVEN, RULE, SCALED) if name in before]
        on_training = {name: measured(before[name], plan, training) for name in unfitted if len(unfitted) > 1}
    raised = {name for name, choice in before.items() if not same_filter(choice, baselines[name])}
    exact: set[str] = set()
    while True:  # until those that the choice is about forget in time by their own gain
        present, proposed = ({name: results[name] for name in side} for side in (before, finalists))
        validation = _chosen(plan, everyone, present, proposed, on_training, data[0].seeds, has_own_seeds)
        rest = {validation.chosen, validation.baseline, validation.candidate} - exact
        if plan.forget is None or not rest:
            break
        for name in rest:
            forgets = plan.forgetting(everyone[name], exact=True)
            if not same_filter(forgets, everyone[name]):
                everyone[name], results[name] = forgets, measured(forgets, plan, data)
                if name in before:
                    raised.add(name)
                if name in on_training:
                    on_training[name] = measured(forgets, plan, training)
        exact |= rest
    validation = validation._replace(met=tuple(met._replace(raised=met.name in raised) for met in validation.met))
    full = _better_with_full_noise(plan, results[validation.chosen], first, training)
    return _with_failures(validation._replace(full=full), plan, training, results, data)


def _chosen(
    plan: Plan,
    everyone: Mapping[str, Choice],
    before: Mapping[str, Measured],
    trials: Mapping[str, Measured],
    on_training: Mapping[str, Measured],
    seeds: tuple[int, ...],
    has_own_seeds: bool,
) -> Validation:
    """The choice between baselines and trials that were measured on validation runs, by `Choosing`."""
    choosing = Choosing(plan, before, trials, on_training)
    candidate, baseline = next(filter(choosing.wins, choosing.order()), choosing.best), choosing.baseline
    chosen = candidate if candidate and choosing.wins(candidate) else baseline
    met = tuple(choosing.met(name, choice) for name, choice in everyone.items())
    validation = Validation(seeds, has_own_seeds, met, baseline, candidate or baseline, chosen, choosing.price)
    results = {**before, **trials}
    if choosing.ratio and plan.consistent and results[chosen].log_scores:
        decided = {name: results[name] for name in (*before, *([candidate] if candidate else []))}
        validation = validation._replace(chosen=_by_log_score(decided, chosen, baseline), by_error=chosen)
    return validation


def _better_with_full_noise(plan: Plan, chosen: Measured, first: Choice, training: Sequence[Data]) -> Met | None:
    """Noise estimation's full Q, or Q and R, if it is significantly better than own parameters; else None."""
    if plan.full_q or plan.scenarios[0].parameters is None:
        return None
    ratio, data, better = plan.objectives[0] not in PROPER, plan.validation_data(), []
    for name, choice in _full_noise(plan, first.name, baseline_size(first)).items():
        if plan.budget is not None and cost_of(choice, plan, training) > plan.budget:
            continue
        choice = plan.forgetting(choice, exact=True)
        result = measured(choice, plan, data)
        gained = over(result, chosen, ratio=ratio)
        if gained.high < (1.0 if ratio else 0.0) and not (ratio and slightly(gained)):
            nis = max(result.nis, key=lambda part: abs(part - 1.0))
            better.append(
                Met(name, choice, result.value, gained, result.proper, nis, _is_consistent(result, plan))
            )
    return min(better, key=lambda met: met.value, default=None)


def _full_noise(plan: Plan, kind: str, ensemble_size: int | None) -> dict[str, Choice]:
    """Noise estimation of own parameters with a full Q, and with a full Q and R, by name."""
    problem = plan.scenarios[0]
    if (
        not filter_type(kind).has_covariance
        or len({(scenario.model().n, scenario.model().m) for scenario in plan.scenarios}) > 1
    ):
        return {}
    choices = {
        FULL_Q: full_noise(kind, problem, plan.seed),
        FULL_QR: full_noise(kind, problem, plan.seed, with_r=True),
    }
    return {
        name: choice if ensemble_size is None else choice.with_size(ensemble_size)
        for name, choice in choices.items()
        if choice is not None
    }


class Choosing:
    """The choice between baselines and trials that were measured on the same runs."""

    def __init__(
        self,
        plan: Plan,
        baselines: Mapping[str, Measured],
        trials: Mapping[str, Measured],
        training: Mapping[str, Measured] | None = None,
    ):
        """Find the best baseline and the best trial; see `validate`.

        Args:
            plan: of the study.
            baselines: on the validation runs, by name.
            trials: likewise.
            training: what was given and the baselines that were not fitted to the training runs, on these.
        """
        self.plan, self.ratio, self.training = plan, plan.objectives[0] not in PROPER, training or {}
        self.baselines, self.trials = dict(baselines), dict(trials)
        self.baseline = self._best_baseline()
        best, self.price = _best_of(plan, self.trials, self.ratio, self.baselines[self.baseline])
        self.best = best or ""

    def _best_baseline(self) -> str:
        """The baseline with the least objective; what was given, unless that one could be taken instead of it."""
        by_value = sorted(self.baselines, key=lambda name: self.baselines[name].value)
        if GIVEN not in self.baselines:
            return by_value[0]
        self.baseline = GIVEN
        better = by_value[: by_value.index(GIVEN)]
        return next((name for name in better if self.wins(name) or self._wins_training(name)), GIVEN)

    def _wins_training(self, name: str) -> bool:
        """Whether a baseline that was not fitted to the training runs is better than the given filter there."""
        if name not in self.training:
            return False
        pair = self.training[name], self.training[GIVEN]
        return is_better(*pair, ratio=self.ratio) and not logs_with_loss(*pair, ratio=self.ratio)

    def order(self) -> Iterator[str]:
        """The best trial, then of the others those that can be taken, the best first."""
        if self.best:
            yield self.best
        remaining = {name: result for name, result in self.trials.items() if name != self.best and self.wins(name)}
        while remaining:
            best, _ = _best_of(self.plan, remaining, self.ratio)
            yield str(best)
            del remaining[str(best)]

    def met(self, name: str, choice: Choice) -> Met:
        """A filter beside the best baseline."""
        result, other = {**self.baselines, **self.trials}[name], self.baselines[self.baseline]
        nis = max(result.nis, key=lambda part: abs(part - 1.0))
        lost = [
            self.plan.scenarios[problem].log_names[log]
            for problem, log in logs_with_loss(result, other, ratio=self.ratio)
        ]
        return Met(
            name,
            choice,
            result.value,
            over(result, other, ratio=self.ratio),
            result.proper,
            nis,
            _is_consistent(result, self.plan),
            result.nees,
            result.state_nees,
            signed_rank(result, other, ratio=self.ratio),
            tuple(lost),
        )

    def wins(self, name: str) -> bool:
        """Whether a trial can be taken instead of the best baseline."""
        nothing = Choice("", {}, {})
        return _wins(self.met(name, nothing), self.met(self.baseline, nothing), self.plan, self.ratio)


def _with_failures(
    validation: Validation, plan: Plan, training: Sequence[Data], met: Mapping[str, Measured], data: Sequence[Data]
) -> Validation:
    """With the runs in which what was given fails, or the best baseline where nothing was given."""
    from scipy.special import chdtrc

    tested = validation.named(GIVEN if GIVEN in met else validation.baseline)
    pair, failures, count = (tested, validation.named(validation.candidate)), [], 0
    sets = (
        [(training, [measured(entry.choice, plan, training).runs for entry in pair])]
        if validation.has_own_seeds
        else []
    )
    for datasets, (ours, theirs) in [*sets, (data, [met[entry.name].runs for entry in pair])]:
        for problem, part, a, b in zip(plan.scenarios, datasets, ours, theirs, strict=True):
            count += len(part.seeds)
            nis, other = (runs.nis / np.maximum(runs.channels, 1) for runs in (a, b))
            fails = (nis > FAILS) & (chdtrc(np.maximum(a.channels, 1), a.nis) < RARE)
            failures += [
                Failure(problem.run_label(part.seeds[i]), float(nis[i]), float(other[i]))
                for i in np.flatnonzero(fails).tolist()
            ]
    worst = sorted(failures, key=lambda failure: -failure.nis)[:WORST]
    return validation._replace(tested=tested.name, failures=tuple(worst), failed=len(failures), runs=count)


def _rescaled(finalists: Mapping[str, Choice], plan: Plan, training: Sequence[Data]) -> dict[str, Choice]:
    """The first two trials with Q and R multiplied by their mean NEES over n; none where that is not free.

    A common factor on Q and R leaves the gain of a linear filter as it is, and divides its NEES: of all factors
    this one has the best log score. Without truth those of an ensemble, which may have got another size, are
    multiplied by their mean NIS over m, and others, of which the likelihood has found the factor, are not.
    """
    rescaled: dict[str, Choice] = {}
    parameters = [
        parameter
        for parameter in model_parameters(plan.scenarios[0], **plan.options)
        if parameter.place.is_variance
    ]
    for name in list(finalists)[:BY_CONSISTENCY] if plan.rescales else ():
        choice, before = finalists[name], measured(finalists[name], plan, training)
        factor = before.nees
        if isnan(factor) and filter_type(choice.name).has_ensemble:
            factor = geometric_mean(before.nis) if min(before.nis) > 0.0 else nan
        if not 0.0 < factor < LARGEST:
            continue
        for parameter in parameters:
            value = parameter.get(choice)
            if value is not None:
                choice = parameter.set(choice, min(max(factor * value, parameter.low), parameter.high))
        rescaled[f"{name} rescaled"] = plan.forgetting(choice)
    return rescaled


def _baselines_of(plan: Plan, first: Choice, training: Sequence[Data]) -> dict[str, Choice]:
    """The baselines of a finalist but the oracle, within the budget; of several problems those of the first.

    None forgets in time yet (`Plan.forgetting`).

    An ensemble has `baseline_size` members, or, over the budget, the fewer of the finalist's and the usual ones.
    """
    size, budget = baseline_size(first), plan.budget
    baselines = _competing(plan, first.name, size)
    if budget is None:
        return baselines
    pairs = {name: [choice] for name, choice in baselines.items()}
    if size is not None:
        least = min(first.numbers.get("ensemble_size", size), ensemble_sizes_of(filter_type(first.name)).untuned)
        for name, choice in _competing(plan, first.name, least).items():
            pairs.setdefault(name, []).append(choice)
    within = (
        (name, choice)
        for name, choices in pairs.items()
        for choice in choices
        if cost_of(choice, plan, training) <= budget
    )
    affordable: dict[str, Choice] = {}
    for name, choice in within:
        affordable.setdefault(name, choice)
    return affordable


def _competing(plan: Plan, kind: str, ensemble_size: int | None) -> dict[str, Choice]:
    """The baselines of a filter but the oracle, of any cost.

    Where R is held none of them changes it, and relations among numbers hold for all but what was given.
    """
    problem = plan.scenarios[0]
    baselines = competing_baselines(kind, problem, plan.seed, ensemble_size)
    if plan.hold_r and filter_type(kind).has_covariance:
        held_noise = {"measurement_noise_cov": problem.untuned["measurement_noise_cov"]}
        baselines = {
            name: choice._replace(model={**choice.model, **held_noise}) for name, choice in baselines.items()
        }
    if plan.where:
        free = model_parameters(problem, **plan.options)
        baselines = {
            name: choice if name == GIVEN else obeying(choice, free) for name, choice in baselines.items()
        }
    sizes = {(scenario.model().n, scenario.model().m) for scenario in plan.scenarios}
    if len(sizes) > 1:  # a Q or R fits problems of one size alone
        baselines = {
            name: choice for name, choice in baselines.items() if not set(NOISE_ARGUMENTS) & set(choice.model)
        }
    if plan.full_q and problem.parameters is not None:
        full = _full_noise(plan, kind, ensemble_size)
        baselines |= {name: choice for name, choice in full.items() if plan.full_r or name == FULL_Q}
    return baselines


def _best_of(
    plan: Plan, results: dict[str, Measured], ratio: bool, baseline: Measured | None = None
) -> tuple[str | None, float | None]:
    """The name of the best trial, and what a mean NIS within its band costs; None where there is none."""
    if not results:
        return None, None
    free = min(results, key=lambda name: results[name].value)
    near = [name for name, result in results.items() if result.value <= (1.0 + MOST_PRICE) * results[free].value]
    better = [] if baseline is None else [name for name in near if is_better(results[name], baseline, ratio=ratio)]
    inside = [name for name, result in results.items() if _is_consistent(result, plan)]
    best = min(inside, key=lambda name: results[name].value, default=free)
    price = results[best].value / results[free].value - 1.0 if ratio and plan.is_constrained and inside else None
    if ratio and plan.consistent and results[free].log_scores:
        return max(better or near, key=lambda name: results[name].proper), price
    if not plan.is_constrained or not inside:
        return free, None
    if price is None:  # the objective is a proper score itself
        return (best if over(results[best], results[free], ratio=False).low <= 0 else free), None
    return (best if price <= MOST_PRICE else max(near, key=lambda name: results[name].proper)), price


def _by_log_score(results: Mapping[str, Measured], chosen: str, baseline: str) -> str:
    """Of the filters within 5 % of the least error, the one with the best log score of the true states.

    It replaces the choice by error if its log score is significantly better, or better where the NEES of that
    choice, joint or of a state, is more than a factor of three off. A filter that is significantly worse in error
    than the best baseline, by 0.5 % or more, is not taken.
    """
    most = (1.0 + MOST_PRICE) * min(result.value for result in results.values())
    ratios = {
        name: over(result, results[baseline], ratio=True)
        for name, result in results.items()
        if result.value <= most
    }
    near = [name for name, ratio in ratios.items() if ratio.low <= 1.0 or slightly(ratio)]
    best = max(near, key=lambda name: results[name].proper, default=chosen)
    gained = log_score_gain(results[best], results[chosen])
    wrong = any(is_beyond(nees) for nees in (results[chosen].nees, results[chosen].state_nees))
    return best if gained.low > 0.0 or (wrong and gained.value > 0.0) else chosen


def _wins(candidate: Met, baseline: Met, plan: Plan, ratio: bool) -> bool:
    """Whether the best trial is taken and not the best baseline."""
    if candidate.worse_in:
        return False
    by_ranks = candidate.chance < LEVEL / 2.0
    if not ratio:
        return candidate.over.high < 0.0 or (by_ranks and candidate.over.value < 0.0)
    alone = plan.is_constrained and candidate.consistent and not baseline.consistent
    least = candidate.over.high < (1.0 + EQUAL if alone else 1.0)
    return least or (by_ranks and candidate.over.value < 1.0)


def _is_consistent(result: Measured, plan: Plan) -> bool:
    """Whether the mean NIS is in its band on all problems; true without a band."""
    return not plan.is_constrained or all(NIS_BAND[0] <= nis <= NIS_BAND[1] for nis in result.nis)


def as_data(validation: Validation | None) -> dict | None:
    """The meeting as plain data, for a tuned file and JSON."""
    if validation is None:
        return None
    return {
        "chosen": validation.chosen,
        "candidate": validation.candidate,
        "baseline": validation.baseline,
        "gave_way": validation.gave_way,
        "seeds": [validation.seeds[0], validation.seeds[-1] + 1],
        "own_seeds": validation.has_own_seeds,
        "price": validation.price,
        "by_error": validation.by_error,
        "met": list(map(_met_as_data, validation.met)),
        "full": validation.full and _met_as_data(validation.full),
        "tested": validation.tested,
        "failures": [failure._asdict() for failure in validation.failures],
        "failed_runs": [validation.failed, validation.runs],
    }


def _met_as_data(met: Met) -> dict:
    nees = {
        name: value if isfinite(value) else None
        for name, value in zip(NEES, (met.nees, met.state_nees), strict=True)
    }
    lists = {"over": list(met.over), "worse_in": list(met.worse_in)}
    return {**met._asdict(), **nees, **lists, "choice": met.choice._asdict()}


def choice_from(data: Mapping) -> Choice:
    """A choice from its plain data."""
    return Choice(
        data["name"], {key: _tuples(value) for key, value in data["model"].items()}, dict(data["numbers"])
    )


def _tuples(value):
    return tuple(map(_tuples, value)) if isinstance(value, list) else value
