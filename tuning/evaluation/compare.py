"""Filters side by side on scenarios: errors, consistency, cost, and paired comparisons on the same seeds.

In order: the Q and R that each filter assumes, the comparison, and the filters that can take part in it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np

from filters.augmented import Unknown, augmented_model
from filters.consistency.nees import Interval, rmse_ratios, slightly
from filters.engine.batch import run
from filters.estimators.foreign import label_of
from filters.filter import Filter
from filters.particles.kernels import WeightedFilter
from filters.registry import FILTERS, filter_type, make_filter
from thruster_env.core.checks import one_of, tell
from thruster_env.core.parallel import IN_PROCESS, TaskMap
from tuning.evaluation.baselines import (
    GIVEN,
    NOISE,
    RULE,
    SCALED,
    competing_baselines,
    given_noise,
    noise_estimated,
    oracle,
    rule_of_thumb,
    scaled_default,
)
from tuning.evaluation.evaluate import (
    Evaluation,
    compute_metrics,
    likelihood_gain,
    median_score_ratio,
    score_ratio,
    with_restarts,
)
from tuning.evaluation.residuals import model_error
from tuning.evaluation.runs import RunMetrics, joined, metrics_by_run
from tuning.problems.assumed import beliefs_of
from tuning.problems.check import data_of
from tuning.problems.data import Data, estimates_in_parts
from tuning.problems.problem import Problem
from tuning.search.measures import measured
from tuning.search.parameters import ensemble_sizes_of
from tuning.search.plan import LIKELIHOOD, SCORE, Plan
from tuning.search.space import Choice, has_search_space, time_constants_on
from tuning.search.storage import quiet_optuna
from tuning.search.study import open_study, run_trials, stop_on_interrupt
from tuning.search.trials import best_trial

OF_FILE, OF_FILTER, STUDY = "tuned", "own", "study"
STUDY_TRIALS = 20  # of a comparison's study, if no number is given
TUNING = "tuning"  # how the progress of such a study begins
KNOWLEDGE = ("true", "scaled", "untuned", "given", "noise", STUDY)  # of Q and R; `tuning.compare` explains it
OF_BASELINE = {SCALED: "scaled", RULE: "untuned", GIVEN: "given", NOISE: "noise"}
VERDICTS = {  # in sentences
    "better": "better than",
    "worse": "worse than",
    "tie": "not significantly different from",
    "unknown": "without a likelihood to compare with that of",
}
WIDE = 1.0  # length of a ratio's interval over its value, above which a few runs dominate the mean
SYMBOLS = {"ambient_velocity": "U_0"}  # for labels

# The filters of a comparison in which none is named.
DEFAULT_FILTERS = ("ekf", "enkf", "pf")


class Known(NamedTuple):
    """A filter's choice on a problem, and the source of its Q and R."""

    choice: Choice
    source: str  # one of `KNOWLEDGE`; empty for a filter without a covariance
    note: str = ""  # why it is this one, in a sentence


def known(
    knows: str | None,
    name: Any,
    problem: Problem,
    seed: int = 0,
    trials: int = STUDY_TRIALS,
    ensemble_size: int | None = None,
) -> Known:
    """The choice of a filter with some knowledge, by default as `tuning.compare` explains it.

    Args:
        knows: one of `KNOWLEDGE`, or None.
        name: of the filter.
        problem: what it is compared on.
        seed: of the study whose training runs determine the scaled default, noise estimation and the study.
        trials: of the study ...
        ensemble_size: ... and its N; that of the rule of thumb if None.

    Raises:
        ValueError: if the knowledge is named, and the filter cannot have it on this problem.
        KeyboardInterrupt: after Ctrl-C during the study.
    """
    if knows is not None:
        return _named(knows, name, problem, seed, trials, ensemble_size)
    if problem.true is not None:
        error = model_error(problem, seed)
        if not error:
            return _named("true", name, problem, seed, trials, ensemble_size)
        studied = _studied(name, problem, seed, trials, ensemble_size)
        return studied._replace(note=f"Model and plant differ: {error}.") if studied.source else studied
    default = scaled_default(name, problem, seed, ensemble_size)
    if default.choice is not None:
        return Known(default.choice, "scaled")
    choices = {"given": given_noise(name, problem), "noise": noise_estimated(name, problem, seed)}
    choices["untuned"] = rule_of_thumb(name, problem)
    source, choice = next((key, candidate) for key, candidate in choices.items() if candidate is not None)
    if not filter_type(name).has_covariance:
        return Known(choice, "")
    return Known(choice, source, f"There is no scaled default: {default.reason}.")


def _named(knows: str, name: Any, problem: Problem, seed: int, trials: int, ensemble_size: int | None) -> Known:
    """The choice of a filter with this knowledge; ValueError where there is none."""
    if knows == STUDY:
        return _studied(name, problem, seed, trials, ensemble_size)
    if knows == "untuned":
        return Known(rule_of_thumb(name, problem), knows)
    if knows == "scaled":
        default = scaled_default(name, problem, seed, ensemble_size)
        if default.choice is None:
            raise ValueError(f"{name} must have a scaled default on {problem.name}, but {default.reason}")
        return Known(default.choice, knows)
    if knows == "noise":
        choice, rule = noise_estimated(name, problem, seed), "noise estimation needs true states of all states"
    elif knows == "given":
        choice, rule = (
            given_noise(name, problem),
            "given Q and R must be those of a user's model or of its parameters",
        )
    else:
        choice, rule = oracle(name, problem), "an oracle must know the plant's Q and R"
    if choice is None:
        raise ValueError(f"{rule}, but {problem.name} has none: take one of {', '.join(KNOWLEDGE)}")
    return Known(choice, knows)


@lru_cache(maxsize=64)
def _studied(name: Any, problem: Problem, seed: int, trials: int, ensemble_size: int | None) -> Known:
    """The best on the training seeds of a study's best trial and the baselines but the oracle, all of one N.

    An estimator of another package has no study, nor has a class that no name stands for.
    """
    kind = filter_type(name)
    if kind.is_estimator or not isinstance(name, str) or not has_search_space(name):
        noise = noise_estimated(name, problem, seed)
        return Known(rule_of_thumb(name, problem), "") if noise is None else Known(noise, "noise")
    size = (ensemble_size or ensemble_sizes_of(kind).untuned) if kind.has_ensemble else None
    objective = LIKELIHOOD if problem.scale is None else SCORE
    plan = Plan(name, (problem,), seed, (objective,), ensemble_size=size)
    tell(f"{TUNING} {name} on {problem.name}")
    data = plan.training_data()
    with quiet_optuna():
        study = open_study(STUDY, plan)
        if run_trials(study, plan, data, trials):
            raise KeyboardInterrupt
    choices = {OF_BASELINE[key]: choice for key, choice in competing_baselines(name, problem, seed, size).items()}
    best = best_trial(study.trials)
    if best is not None:
        choices[STUDY] = plan.choice_of(best.params)
    values = {key: measured(choice, plan, data).value for key, choice in choices.items()}
    source = min(values, key=lambda key: values[key])
    return Known(choices[source], source if kind.has_covariance else "")


def unchanged(problem: Problem) -> Problem:
    """The problem itself."""
    return problem


class Contender(NamedTuple):
    """A filter in a comparison, which can be made for any scenario."""

    label: str
    choose: Callable[[Problem], Choice]
    unknown: Mapping[str, Unknown | None] = {}  # constants that it estimates, too; None for a default
    knows: str = ""  # of the plant's Q and R: one of `KNOWLEDGE`, or "tuned"
    suit: Callable[[Problem], Problem] = unchanged  # as the filter assumes it
    known: Callable[[Problem], Known] | None = None  # choice and source of Q and R where the problem decides it

    def filter(self, scenario: Problem) -> Filter:
        """The filter, with the model that the scenario lets it assume."""
        choice = self.choose(scenario)
        filter_ = choice.filter(self.suit(scenario))
        if not self.unknown:
            return filter_
        beliefs = beliefs_of(filter_.model.constants, self.unknown)
        return make_filter(choice.name, augmented_model(filter_.model, beliefs), **choice.numbers)

    def origin(self, scenario: Problem) -> tuple[str, str]:
        """The source of Q and R on a scenario, and a note on it."""
        return (self.knows, "") if self.known is None else self.known(scenario)[1:]

    def beliefs(self, scenario: Problem) -> dict[str | int, Unknown]:
        """The prior of the constants that it also estimates."""
        return (
            beliefs_of(self.choose(scenario).filter(scenario).model.constants, self.unknown)
            if self.unknown
            else {}
        )


class Row(NamedTuple):
    """Metrics of a filter on a scenario, and its comparison with the first filter on the same seeds."""

    label: str
    filter_name: str
    evaluation: Evaluation
    above_bound: np.ndarray  # (n,), RMSE over the bound, less one
    nees: float  # the mean, whose expected value is n, or the median of a particle filter
    nees_is_median: bool
    microseconds: float  # time per step of one run, on all cores
    ratios: tuple[Interval, ...]  # by state, RMSE over the first filter's, paired
    score_ratio: Interval  # score over the first filter's, paired
    likelihood_gain: Interval  # log-likelihood of a run less the first filter's, paired
    knows: str = ""  # of the plant's Q and R, as its `Contender` does
    beliefs: Mapping[str | int, Unknown] = {}  # of the constants that it estimates, too, at first
    note: str = ""  # why its Q and R are these, in a sentence

    @property
    def verdict(self) -> str:
        """Whether the score is significantly lower than the first filter's: "better", "worse" or "tie".

        Without truth the log-likelihood of the innovations decides; "unknown" for a filter that has none.
        """
        if self.evaluation.has_truth:
            return "better" if self.score_ratio.high < 1 else "worse" if self.score_ratio.low > 1 else "tie"
        gain = self.likelihood_gain
        if np.isnan(gain.value):
            return "unknown"
        return "better" if gain.low > 0 else "worse" if gain.high < 0 else "tie"


class Leaderboard(NamedTuple):
    """Filters on one scenario, in the order in which they were given."""

    scenario: Problem
    seeds: Sequence[int]
    bound: np.ndarray  # (n,), for the scenario's Gaussian core on these seeds
    rows: list[Row]


def winners(board: Leaderboard) -> str:
    """The filters that are significantly better or worse than the first one."""
    first, *rest = board.rows
    if not rest:
        return f"On {board.scenario.name} no other filter can be compared with {first.label}."
    parts = []
    for verdict, words in VERDICTS.items():
        names = [f"{row.label}{_doubt(row, first)}" for row in rest if row.verdict == verdict]
        if names:
            parts.append(f"{', '.join(names)} {'is' if len(names) == 1 else 'are'} {words} {first.label}")
    by = "score" if first.evaluation.has_truth else "log-likelihood"
    return f"By the {by} on {board.scenario.name}, {'; '.join(parts)}."


def _doubt(row: Row, first: Row) -> str:
    """What has to be said beside a verdict: the difference is hardly one, or a few runs make the ratio."""
    ratio = row.score_ratio
    if slight := slightly(ratio):
        return f" (by {slight}: practically equal)"
    if row.verdict == "tie" and ratio.high - ratio.low > WIDE * ratio.value:
        median = median_score_ratio(row.evaluation, first.evaluation)
        return f" (undecided: few runs dominate; the median ratio of a run is {median:.2f})"
    return ""


def contender(
    name: str,
    knows: str | None = "true",
    unknown: Mapping[str, Unknown | None] | None = None,
    seed: int = 0,
    trials: int = STUDY_TRIALS,
    **numbers,
) -> Contender:
    """A filter by name.

    Args:
        name: name of a filter; or an estimator, a function that makes one from a model, or "module:object".
        knows: one of `KNOWLEDGE`, as `tuning.compare` explains; None for what is best known on
            each problem.
        unknown: constants of the model to estimate with the states; a belief of None means `default_belief`.
        seed: seed of the study whose training runs scale the scaled default.
        trials: of the study by which Q and R are known.
        **numbers: parameters of the filter, such as `ensemble_size`; by default those of the rule of thumb.

    Raises:
        ValueError: for an unknown name or knowledge. (Parameters and constants are checked when the filter is
            made.)
    """
    kind = filter_type(name)
    if knows is not None:
        one_of("knows", knows, KNOWLEDGE)
    numbers = {key: value for key, value in numbers.items() if value is not None}

    unknown = unknown or {}
    knowing = partial(_known_on, knows, name, bool(unknown), seed, trials, numbers)
    size = [str(numbers.get("ensemble_size", ensemble_sizes_of(kind).untuned))] if kind.has_ensemble else []
    options = [f"{key} {_in_words(value)}" for key, value in numbers.items() if key != "ensemble_size"]
    added = [f"+ {SYMBOLS.get(constant, constant)}" for constant in unknown]
    label = " ".join([kind.label, *size, *options, *added])
    return Contender(label, partial(_choice_with, numbers, knowing), unknown, known=knowing)


def _known_on(
    knows: str | None, name: Any, augments: bool, seed: int, trials: int, numbers: Mapping, scenario: Problem
) -> Known:
    keeps = knows is None and augments and scenario.true is not None
    return known("true" if keeps else knows, name, scenario, seed, trials, numbers.get("ensemble_size"))


def _choice_with(numbers: Mapping, knowing: Callable[[Problem], Known], scenario: Problem) -> Choice:
    choice = knowing(scenario).choice
    return choice._replace(numbers={**choice.numbers, **numbers})


def _in_words(value) -> str:
    if isinstance(value, str):
        return value
    return ", ".join(f"{number:g}" for number in np.ravel(value))


def sized(choice: Choice, ensemble_size: int | None) -> Choice:
    """A choice with another ensemble size, if one is given and the filter has an ensemble."""
    if ensemble_size is None or not filter_type(choice.name).has_ensemble:
        return choice
    return choice.with_size(ensemble_size)


def compare(
    contenders: Sequence[Contender],
    scenarios: Iterable[Problem],
    seeds: Sequence[int] | Callable[[Problem], Sequence[int]],
    on_row: Callable[[Problem, str], None] = lambda scenario, label: None,
    tasks: TaskMap = IN_PROCESS,
) -> tuple[list[Leaderboard], bool]:
    """Run filters over scenarios, all on the same seeds.

    Ctrl-C ends it after a running filter and keeps finished results; a second one ends it at once.

    Args:
        contenders: the filters; the others are compared with the first one.
        scenarios: the problems of the comparison.
        seeds: at least 2, held-out ones for a comparison of tuned filters; or a function that returns the seeds of
            a problem.
        on_row: called with the first scenario and filter's label that are not finished, before each is.
        tasks: what runs each filter on each scenario.

    Returns:
        A leaderboard for each scenario, and whether it was interrupted.

    Raises:
        ValueError: if there are no filters, two have the same label, or one cannot work on a scenario.
        KeyboardInterrupt: if it is interrupted before any row is done.
    """
    labels = [contender.label for contender in contenders]
    if not labels or len(set(labels)) < len(labels):
        raise ValueError(f"a comparison must be of different filters, but got {', '.join(labels) or 'none'}")
    pairs = [(contender, scenario) for scenario in scenarios for contender in contenders]
    # All filters are made before the first one runs, so that an error in the last one is raised at once.
    entries = dict(tasks(entry_of, pairs))
    chosen = {id(scenario): seeds(scenario) if callable(seeds) else seeds for _, scenario in pairs}
    runs = [
        (entries[index].filter, scenario, hashable(chosen[id(scenario)]), contender is contenders[0])
        for index, (contender, scenario) in enumerate(pairs)
    ]
    waiting, finished, interrupted = dict(enumerate(pairs)), {}, False
    try:
        with stop_on_interrupt() as stopped:
            on_row(pairs[0][1], pairs[0][0].label)
            for index, result in tasks(measured_on, runs, stopped):
                finished[index] = result
                del waiting[index]
                for contender, scenario in [] if stopped() else [*waiting.values()][:1]:
                    on_row(scenario, contender.label)
            interrupted = stopped()
    except KeyboardInterrupt:
        interrupted = True
    finally:
        data_and_bound.cache_clear()
    boards: list[Leaderboard] = []
    for index, (contender, scenario) in enumerate(pairs):
        if index not in finished:
            continue
        bound = finished[index].bound
        if bound is not None:
            boards.append(Leaderboard(scenario, chosen[id(scenario)], bound, []))
        if boards and boards[-1].scenario is scenario:  # the first filter, with which it is compared, is finished
            boards[-1].rows.append(_row(contender.label, entries[index], finished[index], boards[-1]))
    if not boards:
        raise KeyboardInterrupt
    return boards, interrupted


class Entry(NamedTuple):
    """A filter for a scenario, and what its row says of it."""

    filter: Filter
    knows: str
    note: str
    beliefs: Mapping[str | int, Unknown]


def entry_of(contender: Contender, scenario: Problem) -> Entry:
    """The entry of a contender."""
    return Entry(contender.filter(scenario), *contender.origin(scenario), contender.beliefs(scenario))


class Measured(NamedTuple):
    """Metrics of a filter on a scenario's seeds, and the seconds that its runs took."""

    evaluation: Evaluation
    seconds: float
    steps: int
    bound: np.ndarray | None  # of the scenario, if it was asked for


def hashable(seeds: Sequence[int]) -> Sequence[int]:
    """The same seeds; a list as a tuple."""
    return tuple(seeds) if isinstance(seeds, list) else seeds


@lru_cache(maxsize=1)
def data_and_bound(scenario: Problem, seeds: Sequence[int]) -> tuple[Data, np.ndarray]:
    """Data of some seeds and the bound on them: filters of the same scenario follow one another."""
    data = data_of(scenario, seeds)
    return data, scenario.bound(data)


def measured_on(filter_: Filter, scenario: Problem, seeds: Sequence[int], with_bound: bool) -> Measured:
    """Run a filter on a scenario's seeds."""
    data, bound = data_and_bound(scenario, seeds)
    runs, seconds = timed_runs(filter_, data, scenario.scale)
    evaluation = with_restarts(compute_metrics(filter_, runs, data, scenario.scale), filter_, runs, data)
    evaluation = evaluation._replace(time_constants=time_constants_on(filter_, scenario))
    return Measured(evaluation, seconds, data.measurements[..., 0].size, bound if with_bound else None)


def _row(label: str, entry: Entry, result: Measured, board: Leaderboard) -> Row:
    evaluation = result.evaluation
    first = board.rows[0].evaluation if board.rows else evaluation
    particles = isinstance(entry.filter, WeightedFilter)
    return Row(
        label=label,
        filter_name=entry.filter.name,
        evaluation=evaluation,
        above_bound=np.array([part.value for part in evaluation.rmse]) / board.bound - 1.0,
        nees=evaluation.median_nees if particles else evaluation.nees.value,
        nees_is_median=particles,
        microseconds=1e6 * result.seconds / result.steps,
        ratios=rmse_ratios(evaluation.mean_squares, first.mean_squares, evaluation.weights),
        score_ratio=score_ratio(evaluation, first),
        likelihood_gain=likelihood_gain(evaluation, first),
        knows=entry.knows,
        beliefs=entry.beliefs,
        note=entry.note,
    )


def timed_runs(filter_: Filter, data: Data, scale) -> tuple[RunMetrics, float]:
    """Metrics of a filter on some data, by run, and the seconds of its runs without compilation.

    The scale selects the states of log scores; None for none.
    """
    observed = data.seen
    few = observed.filter_keys[:2], observed.inputs[:2, :2], observed.measurements[:2, :3]
    run(filter_, *few)
    metrics, seconds, started = [], 0.0, time.perf_counter()
    for runs, estimates in estimates_in_parts(filter_, data):
        seconds += time.perf_counter() - started
        metrics.append(metrics_by_run(filter_, estimates, runs, scale=scale))
        started = time.perf_counter()
    return joined(metrics), seconds


def fitting(names: Iterable[Any], problems: Sequence[Problem]) -> tuple[list[Any], dict[str, str]]:
    """The filters that accept the models of all problems, and by label why the others do not.

    Args:
        names: of filters, or estimators.
        problems: the problems of the comparison.

    Raises:
        ValueError: for an estimator that does not accept a model, or cannot be read: only filters are left out.
    """
    accepted: list[Any] = []
    left_out: dict[str, str] = {}
    for name in names:
        try:
            for problem in problems:
                rule_of_thumb(name, problem).filter(problem)
            accepted.append(name)
        except ValueError as error:
            if not isinstance(name, str) or name not in FILTERS:
                raise
            left_out[label_of(name)] = str(error)
    return accepted, left_out
