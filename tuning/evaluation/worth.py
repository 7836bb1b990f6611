"""Held-out results in words: the gain over each baseline, and a description of the scaled default."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import inf, isfinite, isnan

from filters.consistency.nees import Interval, slightly, span
from filters.consistency.report import rounded
from filters.consistency.time_constants import TimeConstants
from thruster_env.core.checks import in_words
from tuning.evaluation.baselines import GIVEN, NO_RANGES, NOISE, ORACLE, RULE, SCALED, called
from tuning.evaluation.evaluate import Evaluation, farthest, is_beyond
from tuning.evaluation.held_out import Comparison
from tuning.evaluation.residuals import LIFTED, UnevenNis
from tuning.problems.problem import Problem
from tuning.search.space import TOLERANCE

ALIKE = 1.5  # ratio to the oracle's time constant up to which a filter is as slow as the oracle
LARGEST_RATIO = 10.0  # of scores, up or down, that sentences give in percent
MOST_TIMES = 4  # time constants in a sentence
HEADLINE = (GIVEN, SCALED, RULE, NOISE)  # baselines that a headline names, in this order: all but the oracle


def without_truth(name: str) -> str:
    """A sentence on the comparison if a problem, called `name`, has no truth."""
    return (
        f"{name} has no true states, so filters are compared by how well they predict the measurements: by the "
        "log-likelihood and the NIS of their innovations."
    )


def tuning_effect(comparison: Comparison, what: str = "the score") -> str:
    """The effect of tuning on `what` against each baseline but the oracle.

    Without truth it is the effect on the log-likelihood of a run's innovations.
    """
    if not comparison.tuned.has_truth:
        return _likelihood_worth(comparison)
    ratios, seeds = comparison.ratios, len(comparison.seeds)
    names = [name for name in HEADLINE if name in ratios and not (name == GIVEN and comparison.given_is_oracle)]
    parts = []
    for name in names:
        verb, by, much = gain(ratios[name], seeds, what).partition(" by ")
        parts.append((verb, f"{by}{much} against the {called(name)}".strip()))
    return _listed(parts)


def uneven_sentence(uneven: UnevenNis, channels: int) -> str:
    """A mean NIS that a few blocks carry, where, and what to do."""
    blocks = f"{uneven.carrying} of {uneven.blocks} blocks {'carries' if uneven.carrying == 1 else 'carry'}"
    means = [rounded(channels * mean) for mean in (uneven.mean, uneven.rest)]
    where = f"in {'; '.join(uneven.spans)}" if uneven.spans else "spread over them"
    effect = ", so that R or Q is too large for the others" if uneven.rest < 1.0 / LIFTED else ""
    return (
        f"{blocks} the mean NIS, {means[0]}; without {'it' if uneven.carrying == 1 else 'them'} it is {means[1]}, "
        f"where {channels} is right{effect}. The large innovations are of {uneven.channel}, {where}. If that is "
        "garbage, leave it out (--outliers missing, outliers='missing' in Python, where the findings name it; "
        "otherwise make these cells of the log empty), or take --filter ekf-robust."
    )


def warnings_of(evaluation: Evaluation, problem: Problem, forget: float | None = None) -> list[str]:
    """What a headline warns of in a filter.

    It is a NEES that is far off, a gain that hardly moves the estimate, and a mean NIS that a few blocks carry.

    Args:
        evaluation: of the filter.
        problem: on which it was evaluated.
        forget: the longest time constant that was allowed [s]; None for a fifth of a run.
    """
    channels = len(problem.innovations)
    uneven = [] if evaluation.uneven is None else [uneven_sentence(evaluation.uneven, channels)]
    return [*_nees_warning(evaluation), *_memory_warning(evaluation, problem, forget), *uneven]


def _nees_warning(evaluation: Evaluation) -> list[str]:
    """A mean NEES, joint or of a scored state, more than a factor of three off."""
    if not evaluation.has_truth:
        return []
    joint, n, states = evaluation.nees, len(evaluation.rmse), evaluation.scored_nees
    far = {name: ratio for name, ratio in states.items() if is_beyond(ratio)}
    if not far and not is_beyond(joint.value / n):
        return []
    parts = []
    for size, end in (("small", "up"), ("large", "down")):
        ratios = {name: ratio for name, ratio in far.items() if (ratio > 1.0) == (size == "small")}
        if ratios:
            until = "" if len(ratios) == 1 else f"{end} to "
            most = f"mean NEES {until}{rounded(farthest(ratios.values()))}"
            parts.append(f"too {size} for {', '.join(ratios)} ({most} where 1 is right)")
    joint_size = _size_of(joint, n)
    if joint_size:
        parts.append(f"{joint_size} jointly ({rounded(joint.value)} where {n} is right)")
    reason = ""
    if not far:
        reason = ": each variance is about right, but P is nearly singular, or its correlations are wrong"
    elif joint_size and not any(part.startswith(joint_size) for part in parts[:-1]):
        reason = ": its correlations are wrong, too"
    return [f"Do not rely on the covariance, it is {in_words(parts)}{reason}."]


def _size_of(nees: Interval, n: int) -> str:
    """Whether P is "too small" or "too large" by a mean NEES; empty where it may be right or is unknown."""
    if isnan(nees.value) or (nees.covers(n) and not is_beyond(nees.value / n)):
        return ""
    return "too small" if nees.value > n else "too large"


def _memory_warning(evaluation: Evaluation, problem: Problem, forget: float | None) -> list[str]:
    """A time constant that is longer than was allowed or than a fifth of a run, or a gain of practically zero.

    A filter that is as slow as the one with the plant's own Q and R is not warned of.
    """
    constants = evaluation.time_constants
    if constants is None or not constants.steps:
        return []
    slowest = _times(constants.steps[:1], problem)
    if forget is not None and problem.dt is not None:
        if constants.steps[0] * problem.dt <= forget * TOLERANCE:
            return []
        return [
            f"The longest time constant of the gain is {slowest} and misses --forget {forget:g}: a larger Q "
            "shortens it no further."
        ]
    if is_like_the_oracle(constants):
        return []
    run = f"{_run_in_words(problem)} ({_times([constants.length], problem)})"
    if constants.is_slow:
        state, oracle = problem.errors[constants.slowest].short_label.split(" [")[0], ""
        if constants.oracle is not None:
            oracle = f" With the plant's own Q and R it is {_times(constants.oracle[:1], problem)}."
        return [
            f"The longest time constant of the gain, of {state}, is {slowest}, more than a fifth of {run}: after "
            f"a disturbance that no run had, the estimate needs that long to recover.{oracle} "
            f"{_advice(constants, problem)}"
        ]
    if constants.has_no_gain:
        return [
            f"The gain is practically zero: updates need {_times([constants.uptake], problem)} to take up 63 % of "
            f"an innovation, longer than {run}. The filter follows its model alone; a larger Q changes that."
        ]
    return []


def is_like_the_oracle(constants: TimeConstants) -> bool:
    """Whether a filter that sleeps is practically as slow as the same filter with the plant's own Q and R."""
    if constants.oracle is None:
        return False
    pairs = zip((constants.steps[0], constants.uptake), constants.oracle, strict=True)
    slow = (constants.is_slow, constants.has_no_gain)
    return all(steps <= ALIKE * oracle for (steps, oracle), counts in zip(pairs, slow, strict=True) if counts)


def _run_in_words(problem: Problem) -> str:
    if problem.shortest_log is None:
        return "a run"
    word = "log" if problem.seed_word == "blocks" else "run"
    return f"the {word}" if len(problem.log_names) == 1 else f"the shortest {word}"


def _advice(constants: TimeConstants, problem: Problem) -> str:
    """How to make a filter that sleeps forget sooner."""
    if problem.dt is None:
        return "A larger Q shortens it."
    if constants.advised is None:
        return "A larger Q hardly shortens it: measure more, or more often."
    return f"--forget {constants.advised:g} keeps it within {constants.advised:g} s."


def memory_numbers(comparison: Comparison, problem: Problem, forget: float | None = None) -> dict:
    """The longest time constant of a tuned filter's gain and what it is compared with [s], for JSON.

    Without a sample time they are in steps. None stands for what is infinite or unknown.
    """
    constants, dt = comparison.tuned.time_constants, problem.dt or 1.0
    if constants is None or not constants.steps:
        return {"longest": None, "run": None, "oracle": None, "allowed": forget, "advised": None, "warns": False}
    longest, oracle = (value * dt for value in (constants.steps[0], (constants.oracle or (inf,))[0]))
    return {
        "longest": longest if isfinite(longest) else None,
        "run": constants.length * dt,
        "oracle": oracle if isfinite(oracle) else None,
        "allowed": forget,
        "advised": constants.advised,
        "warns": bool(_memory_warning(comparison.tuned, problem, forget)),
    }


def memory_sentence(evaluation: Evaluation, problem: Problem) -> str:
    """The time constants of a filter's gain, the longest first; "-" for a filter without a gain."""
    constants = evaluation.time_constants
    if constants is None or not constants.steps:
        return "Time constants of the gain: -."
    states = problem.errors
    longest, more = constants.steps[:MOST_TIMES], len(constants.steps) - MOST_TIMES
    rest = f" and {more} shorter ones" if more > 0 else ""
    slowest = states[constants.slowest].symbol
    sentence = f"Time constants of the gain: {_times(longest, problem)}{rest}; the longest is of {slowest}"
    if constants.unobservable:
        names = ", ".join(states[i].symbol for i in constants.unobservable)
        sentence += f"; the measurements alone do not determine {names}, whatever the gain"
    if is_like_the_oracle(constants):
        assert constants.oracle is not None
        sentence += (
            f". The plant's own Q and R give {_times(constants.oracle[:1], problem)}: such a slow filter is "
            f"right, as long as nothing else disturbs the plant. {_advice(constants, problem)[:-1]}"
        )
    return f"{sentence}."


def slowest_sentence(evaluations: Mapping[str, Evaluation], problem: Problem) -> str:
    """The longest time constant of each filter's gain; "-" for a filter without a gain."""
    by_filter = {name: evaluation.time_constants for name, evaluation in evaluations.items()}
    parts = [
        f"{name} {_times(constants.steps[:1], problem) if constants is not None and constants.steps else '-'}"
        for name, constants in by_filter.items()
    ]
    return f"Longest time constant of the gain: {', '.join(parts)}."


def _times(steps: Sequence[float], problem: Problem) -> str:
    """Numbers of steps as times [s], or as steps where there is no sample time."""
    dt = 1.0 if problem.dt is None else problem.dt
    return f"{', '.join(rounded(number * dt) for number in steps)} {'steps' if problem.dt is None else 's'}"


def all_warnings(
    comparisons: Sequence[Comparison], problems: Sequence[Problem], forget: float | None = None
) -> list[str]:
    """The warnings of a tuned filter on all problems of a study; `forget` as in `warnings_of`."""
    prefixes = [f"{problem.name}: " if len(problems) > 1 else "" for problem in problems]
    pairs = zip(comparisons, problems, strict=True)
    warnings = [warnings_of(comparison.tuned, problem, forget) for comparison, problem in pairs]
    return [
        f"{prefix}{sentence}"
        for prefix, sentences in zip(prefixes, warnings, strict=True)
        for sentence in sentences
    ]


def _likelihood_worth(comparison: Comparison) -> str:
    gains = {name: gained for name, gained in comparison.likelihood_gains.items() if name in HEADLINE}
    parts = [
        ("changes the log-likelihood of a run", f"by {span(gained, 2, sign='+')} against the {called(name)}")
        for name, gained in gains.items()
        if not isnan(gained.value)
    ]
    return _listed(parts) if parts else "has no effect that is measurable without truth"


def _listed(parts: Sequence[tuple[str, str]]) -> str:
    """Verbs and what follows them, with commas and an "and": a verb is not said again after the same."""
    phrases = [rest if i and parts[i - 1][0] == verb else f"{verb} {rest}" for i, (verb, rest) in enumerate(parts)]
    return in_words(phrases)


def sized(gained: Interval) -> Interval:
    """A gain with its interval, or the size of a loss, to go before "above" or "below"."""
    return gained if gained.value >= 0 else Interval(-gained.value, -gained.high, -gained.low)


def gain(ratio: Interval, seeds: int, what: str = "the score") -> str:
    """A ratio of scores over those of a baseline in words, with its interval."""
    if ratio.low <= 1 <= ratio.high:
        return f"makes no significant difference on {seeds} seeds"
    ends = sorted(100 * abs(1 - part) for part in (ratio.low, ratio.high))
    verb = "lowers" if ratio.high < 1 else "raises"
    if slight := slightly(ratio):
        return f"{verb} {what} by {slight} (practically nothing)"
    if not 1.0 / LARGEST_RATIO < ratio.value < LARGEST_RATIO:
        return f"{verb} {what} {times(ratio)}"
    return f"{verb} {what} by {span(Interval(100 * abs(1 - ratio.value), *ends), 0, ' %')}"


def times(ratio: Interval) -> str:
    """A ratio far from 1 as a factor, "by a factor of 250 [240, 260]", where percentages all round to 100."""
    parts = ratio if ratio.value > 1.0 else (1.0 / part if part > 0.0 else inf for part in ratio)
    value, *ends = map(rounded, parts)
    low, high = ends if ratio.value > 1.0 else ends[::-1]
    return f"by a factor of {value}" + ("" if low == high else f" [{low}, {high}]")


def scaling_sentence(comparison: Comparison) -> str:
    """A description of the scaled default, or why there is none; empty if the comparison has no record of it."""
    default = comparison.default
    if default is None:
        return ""
    remark, first = f" {NO_RANGES}" if comparison.lacks_ranges else "", comparison.baselines[0]
    rule = f"{RULE} with its" if comparison.rule == RULE else "given Q and R with this"
    if default.choice is None:
        so = f", so the {RULE} comes first" if first == RULE else ""
        return f"There is no {SCALED}{so}: {default.reason}.{remark}"
    if default.factor is None or default.nis is None:
        raise ValueError(f"a scaled default must have its factor and mean NIS, but got {default}")
    oracle = f"; the {ORACLE} has the plant's own Q and R" if comparison.true is not None else ""
    return (
        f"The {SCALED} is the {rule} Q times {default.factor:.4g}, which brings the mean NIS on the "
        f"training runs to {default.nis * comparison.tuned.expected_nis:.2f}{oracle}.{remark}"
    )
