"""The result of a tuning in sentences: the choice and its reason, the gain over baselines, doubts about the model.

In order: the comparison of the best trials with the baselines; the gain of tuning; what residuals say of the
model; and the parameters of a filter in words, each with its unit.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from math import isfinite, isnan
from typing import Any

import numpy as np

from filters.consistency.nees import Interval, slightly, span
from filters.consistency.report import confidence, rounded
from thruster_env.core.checks import in_words
from thruster_env.model.quantities import Quantity
from tuning.evaluation.baselines import FULL_Q, FULL_QR, TUNED, called, is_far_below
from tuning.evaluation.evaluate import is_beyond
from tuning.evaluation.held_out import Comparison
from tuning.evaluation.residuals import noise_estimation, tails_in_words
from tuning.evaluation.worth import LARGEST_RATIO, scaling_sentence, sized, times, without_truth
from tuning.problems.assumed import may_estimate_constants, within
from tuning.problems.find import logs_package
from tuning.problems.problem import Problem
from tuning.search.measures import LEVEL
from tuning.search.parameters import index_pairs
from tuning.search.plan import LIKELIHOOD, LOG_SCORE, MOST_PRICE, MSE, NIS_BAND, PROPER, nis_ratio
from tuning.search.space import Choice, everything_of, neutral, parameters, parameters_of
from tuning.search.validation import choice_from

FULL_NOISE = {FULL_Q: "--full-q", FULL_QR: "--full-q --full-r"}  # by the option that lets it compete with trials
GIVEN_IS_ORACLE = (
    "The given Q and R are the plant's own, as the oracle's are; no trial of a study starts from them."
)

# Of doubts about the model.
SMALL = 0.1  # of a mean over its deviation, or of a correlation: what is below says little of a model
STRONG = 0.5  # correlation of residuals with the next step, above which a headline says that the model is wrong
LARGE_NIS = 3.0  # mean NIS of the given Q and R over its expected value, above which the model is in doubt
MADE_UP = "made consistent by Q and R, not by the model"
JOINTLY = "consistent jointly, but not in each state"

# Of parameters in words.
MOST_CORRELATIONS = 3  # of three states or channels: more are one row with the largest
ALIKE = 4  # so many numbers of one kind and more, which are the same in every column, share a row


def choice_sentences(validation: Mapping[str, Any] | None, plan: Any) -> list[str]:
    """The choice and its reason, the runs in which what was given fails, and what a mean NIS in its band costs.

    Args:
        validation: from `tuning.search.validation.as_data`, or of a tuned file; None gives no sentence.
        plan: of the study.
    """
    if not validation:
        return []
    met = {contender["name"]: contender for contender in validation["met"]}
    candidate, baseline, chosen = validation["candidate"], validation["baseline"], validation["chosen"]
    likely = plan.objectives[0] in PROPER
    over, what = met[candidate]["over"], _what(plan)
    where = f"{len(_range(validation['seeds']))} validation {plan.scenarios[0].seed_word}"
    if not validation["own_seeds"]:
        where = f"the training {plan.scenarios[0].seed_word}, because there are too few to set some aside"
    best, the, members = f"the best baseline, the {called(baseline)}", _the(candidate), _members(met[chosen])
    if candidate == baseline:
        sentences = [f"The study returns the {called(baseline)}: every trial is the same filter as a baseline."]
    elif validation.get("by_error") and validation["by_error"] != chosen:
        sentences = [_log_score_sentence(met[chosen], met[validation["by_error"]], where, what)]
    elif validation["gave_way"]:
        lost = met[candidate].get("worse_in")
        without, but = "", ""
        if lost:
            is_better = over[0] < (0.0 if likely else 1.0)
            without = " without being worse in a log" if is_better else ""
            but = f", {'but' if is_better else 'and'} it is worse in {in_words(lost)}"
        none_is, its = f"{the} is not", f"its {what}"
        if _is_trial(candidate):
            none_is, its = "no trial is", f"{candidate}'s {what}"
        sentences = [
            f"The study returns the {called(baseline)}{members}: on {where} {none_is} significantly better"
            f"{without} ({its} is {_over(over, likely)}{but})."
        ]
    elif _is_even(over, likely) and met[candidate].get("chance", 1.0) < LEVEL / 2:
        sentences = [
            f"The study returns {the}: on {where} its {what} is {_over(over, likely, best)}, and it is "
            f"better in most of them (Wilcoxon's signed ranks, p = {met[candidate]['chance']:.2g})."
        ]
    elif _is_even(over, likely):
        sentences = [
            f"The study returns {the}: on {where} it has the same {what} as {best}, whose mean NIS is "
            "outside its band."
        ]
    else:
        sentences = [f"The study returns {the}: on {where} its {what} is {_over(over, likely, best)}."]
    sentences += [*_raised_sentence(met, baseline, chosen, plan), *_sizes_sentence(met, chosen)]
    if candidate != chosen and chosen in FULL_NOISE:
        sentences.append(
            f"Your own parameters cannot express the Q and R of the {called(chosen)}; those of {the} are "
            f"{_own(met[candidate], plan)}."
        )
    channels = len(plan.scenarios[0].innovations)
    if validation.get("failures"):
        sentences.append(_failures_sentence(validation, plan.scenarios[0].seed_word, channels))
    if validation["price"] is not None and validation["price"] > MOST_PRICE:
        sentences.append(_price_sentence(validation, met[candidate], what, channels))
    elif plan.is_constrained and not met[chosen]["consistent"]:
        sentences.append(_outside_sentence(met[chosen], where, channels))
    if validation.get("full"):
        sentences.append(_full_sentence(validation["full"], what, where, likely))
    return sentences


def _raised_sentence(met: Mapping[str, Mapping], baseline: str, chosen: str, plan: Any) -> list[str]:
    """That baselines which the sentence above names have a larger Q than in tables, in a list; empty otherwise."""
    raised = [called(name) for name in dict.fromkeys((baseline, chosen)) if met[name].get("raised")]
    if not raised:
        return []
    have, those = ("has", "that") if len(raised) == 1 else ("have", "those")
    return [
        f"Here the {in_words(raised)} {have} a larger Q, to forget within {plan.forget:g} s (--forget); {those} "
        "of the tables may remember longer."
    ]


def _full_sentence(full: Mapping[str, Any], what: str, where: str, likely: bool) -> str:
    """How much better a full Q is than what own parameters express."""
    option = FULL_NOISE[full["name"]]
    matrices = full["name"].removeprefix("noise estimation with ")
    value, low, high = full["over"]
    ends = sorted(-100 * (part - 1.0) for part in (low, high))
    gained = f"it would be {span(Interval(100 * (1.0 - value), *ends), 1, ' %')} better"
    if likely:
        gained = f"its {what} would be {_over(full['over'], likely)}"
    return (
        f"With {matrices} of noise estimation, which your own parameters cannot express, {gained} on {where} "
        f"({option})."
    )


def _log_score_sentence(chosen: Mapping, by_error: Mapping, where: str, what: str) -> str:
    """The filter that the log score decided for, beside the one of the least error."""
    names = [_the(contender["name"]) for contender in (chosen, by_error)]
    ratio, gained = chosen["value"] / by_error["value"], chosen["proper"] - by_error["proper"]
    nees = [_nees_words(contender) for contender in (chosen, by_error)]
    return (
        f"The study returns {names[0]} for its log score, the log density of the true state: on {where} that is "
        f"{gained:.3g} a step above that of {names[1]}, at {ratio:.3f} times the {what}. Its mean NEES is "
        f"{nees[0]}; that of {names[1]} is {nees[1]}."
    )


def _nees_words(met: Mapping) -> str:
    """The mean NEES over its expected value, joint and of the farthest state."""
    joint, single = (math.nan if met.get(name) is None else met[name] for name in ("nees", "state_nees"))
    return f"{rounded(joint)} times its expected value ({rounded(single)} times in the farthest state)"


def _is_trial(name: str) -> bool:
    return name.startswith("trial ")


def _the(name: str) -> str:
    return name if _is_trial(name) else f"the {called(name)}"


def _size(met: Mapping) -> int | None:
    """The ensemble size of one of those that met; None without an ensemble."""
    return met["choice"]["numbers"].get("ensemble_size")


def _members(met: Mapping) -> str:
    """The ensemble size of one of those that met, after its name; empty without an ensemble."""
    size = _size(met)
    return "" if size is None else f" with N = {size} members"


def _sizes_sentence(met: Mapping[str, Mapping], chosen: str) -> list[str]:
    """The ensemble sizes of the filters of the chosen type that met, in a list; empty without an ensemble."""
    kind = met[chosen]["choice"]["name"]
    sizes = {name: _size(contender) for name, contender in met.items() if contender["choice"]["name"] == kind}
    same = {name: size for name, size in sizes.items() if size}
    trials, baselines = (
        {size for name, size in same.items() if _is_trial(name) == part} for part in (True, False)
    )
    if len(trials | baselines) == 1:
        return [f"Trials and baselines have N = {min(trials | baselines)} members here."]
    if len(trials) == len(baselines) == 1:
        return [f"Trials have N = {min(trials)} members here, baselines {min(baselines)}."]
    return []


def _failures_sentence(validation: Mapping, word: str, channels: int) -> str:
    """Where what was given fails, and how the best trial does there."""
    failed, runs = validation["failed_runs"]
    candidate, tested = validation["candidate"], validation["tested"]
    named = []
    for failure in validation["failures"]:
        other = "" if candidate == tested else f"; {_the(candidate)}: {rounded(channels * failure['candidate'])}"
        named.append(f"{failure['run']} (mean NIS {rounded(channels * failure['nis'])}{other})")
    worst = "" if failed == len(named) else "worst "
    return (
        f"The {called(tested)} fails in {failed} of {runs} {word}, {worst}in {in_words(named)}; a mean NIS "
        f"of {channels} is right."
    )


def _price_sentence(validation: Mapping, chosen: Mapping, what: str, channels: int) -> str:
    trials = [contender for contender in validation["met"] if contender["name"].startswith("trial ")]
    inside = [trial for trial in trials if trial["consistent"]]
    best = min(inside, key=lambda trial: trial["value"])
    has = [
        f"has a {what} of {rounded(contender['value'])} and a mean NIS of {rounded(channels * contender['nis'])}"
        for contender in (best, chosen)
    ]
    return (
        f"A mean NIS in its band would cost {100 * validation['price']:.3g} % of the {what}, more than the "
        f"{100 * MOST_PRICE:g} % allowed: {best['name']}, the best in the band, {has[0]}. Of the trials within "
        f"{100 * MOST_PRICE:g} % of the best, {chosen['name']} has the best log score; it {has[1]}, where "
        f"{channels} is right."
    )


def _outside_sentence(chosen: Mapping, where: str, channels: int) -> str:
    """That the mean NIS of the choice is outside its band."""
    low, high = (channels * end for end in NIS_BAND)
    return (
        f"On {where} the mean NIS of {_the(chosen['name'])} is {rounded(channels * chosen['nis'])}, outside its "
        f"band, {low:g} to {high:g}, where {channels} is right: do not rely on its innovation covariance."
    )


def _over(interval: Sequence[float], likely: bool, other: str = "") -> str:
    """A ratio of errors, or a difference of log-likelihoods, in words: over those of `other` if that is named."""
    value, low, high = interval
    if likely:
        value, low, high = sized(Interval(-value, -high, -low))
    known = isfinite(low + high)
    if not likely:
        times = f"{span(Interval(value, low, high), 3) if known else format(value, '.3f')} times"
        return f"{times} that of {other}" if other else f"{times} as large"
    ends = [rounded(part) for part in (value, low, high)]
    much = f"{ends[0]} [{ends[1]}, {ends[2]}]" if known and ends[1] != ends[2] else ends[0]
    words = ("above", "higher") if -interval[0] >= 0.0 else ("below", "lower")
    return f"{much} {words[0]} that of {other}" if other else f"{much} {words[1]}"


def _own(validation: Mapping[str, Any], plan: Any) -> str:
    """The user's own parameters of a validated choice, in words."""
    choice = choice_from(validation["choice"])
    values = [(parameter, parameter.get(choice)) for parameter in plan.scenarios[0].parameters]
    return ", ".join(
        f"{parameter.name} = {value:.3g} {parameter.unit}".rstrip()
        for parameter, value in values
        if value is not None
    )


def _is_even(interval: Sequence[float], likely: bool) -> bool:
    return not interval[2] < (0.0 if likely else 1.0)


def _what(plan: Any) -> str:
    named = {
        "score": "score",
        MSE: "mean square error",
        LOG_SCORE: "log score",
        LIKELIHOOD: "log-likelihood of a run",
    }
    return named.get(plan.objectives[0], "error")


def _range(ends: Sequence[int]) -> range:
    return range(*ends)


def gains(comparison: Comparison, seed_word: str, name: str = TUNED) -> list[str]:
    """The gain of tuning over each baseline, the main one first, and a description of that one."""
    if not comparison.tuned.has_truth:
        return _likelihood_gains(comparison, seed_word, name)
    ratios = comparison.ratios
    parts = [f"{span(ratio, 3)} times that of the {called(name)}" for name, ratio in ratios.items()]
    first, where = next(iter(ratios)), f"{len(comparison.seeds)} held-out {seed_word}"
    sentence = f"Score of the {_filter(name)} on {where}: {', '.join(parts)} (paired 95 % intervals)."
    scaling = scaling_sentence(comparison)
    if name == TUNED:
        sentence += f" {_verdict(ratios[first], called(first), seed_word)}"
    same = [GIVEN_IS_ORACLE] if comparison.given_is_oracle else []
    return [sentence, *([scaling] if scaling else []), *same]


def _filter(name: str) -> str:
    """The filter that is compared, after "the"."""
    return f"{name} filter" if name == TUNED else name


def _likelihood_gains(comparison: Comparison, seed_word: str, name: str) -> list[str]:
    """The gain of tuning without truth: the increase of the log-likelihood of a run."""
    gained = {name: gain for name, gain in comparison.likelihood_gains.items() if not isnan(gain.value)}
    sentences, scaling = [without_truth("This problem")], scaling_sentence(comparison)
    if gained:
        parts = [
            f"{span(sized(gain), 2)} {'above' if gain.value >= 0 else 'below'} that of the {called(name)}"
            for name, gain in gained.items()
        ]
        where = f"{len(comparison.seeds)} held-out {seed_word}"
        sentences.append(f"Log-likelihood of a run of the {_filter(name)} on {where}: {', '.join(parts)}.")
    return [*sentences, *([scaling] if scaling else [])]


def _verdict(ratio: Interval, name: str, seed_word: str) -> str:
    if slight := slightly(ratio):
        changed = "lower" if ratio.high < 1 else "higher"
        return f"Practically equal to the {name}: the error is {changed} by {slight}."
    if ratio.high < 1:
        much = times(ratio) if ratio.value < 1.0 / LARGEST_RATIO else f"by {100 * (1 - ratio.value):.0f} %"
        return f"Tuning lowers the error {much} against the {called(name)}."
    if ratio.low > 1:
        return f"Tuning makes the filter worse than the {name}."
    return f"No significant difference from the {name} on these {seed_word}."


def residual_sentences(problem: Problem, seed: int = 0) -> list[str]:
    """What noise estimation tells beside its Q and R, in a sentence; none where there is no truth.

    Of the process noise w = x' - f(x, u) and the measurement noise v = z - h(x) of the training runs it gives the
    mean over the deviation and the correlation with the next step, where one of these is above 0.1.
    """
    noise = noise_estimation(problem, seed)
    if noise.process_cov is None or noise.measurement_cov is None:
        return []
    w = _told(problem.errors, noise.process_cov, noise.process_mean, noise.process_correlation)
    v = _told(problem.innovations, noise.measurement_cov, noise.measurement_mean, noise.measurement_correlation)
    parts = [f"{what} {', '.join(remarks)}" for what, remarks in (("w of", w), ("v of", v)) if remarks]
    wrong = {f"{what} {remark.partition(' (')[0]}" for what, each in (("w of", w), ("v of", v)) for remark in each}
    heavy, tails = {name: share for name, share in noise.tails.items() if name not in wrong}, []
    if heavy:
        tails = [
            f"The residuals of the true states have heavy tails, {tails_in_words(heavy)}: outliers raise Q "
            "or R of noise estimation for all samples; --filter ekf-robust gives them less weight."
        ]
    if not parts and tails:
        return tails
    if not parts:
        return [
            "The residuals of the true states, w = x' - f(x, u) and v = z - h(x), look like white noise: each "
            f"mean over its standard deviation and each correlation with the next step is below {SMALL:g}."
        ]
    return [
        f"The residuals of the true states, w = x' - f(x, u) and v = z - h(x), are not zero-mean white noise: "
        f"{'; '.join(parts)} (mean over standard deviation; correlation with the next step). The model is wrong "
        "there, and no Q and R make up for it.",
        *tails,
    ]


def _told(
    quantities: tuple[Quantity, ...], cov: np.ndarray, mean: np.ndarray | None, correlation: np.ndarray | None
) -> list[str]:
    deviations = np.sqrt(np.diag(cov))
    if mean is None or correlation is None or not deviations.any():
        return []
    relative = np.divide(mean, deviations, out=np.zeros_like(mean), where=deviations > 0)
    rows = zip(quantities, relative.tolist(), correlation.tolist(), strict=True)
    return [f"{quantity.symbol} ({a:+.2g}; {b:+.2g})" for quantity, a, b in rows if max(abs(a), abs(b)) > SMALL]


def model_doubts(problem: Problem, comparison: Comparison, seed: int = 0) -> list[str]:
    """Strong evidence against a model, in a list; empty if there is none.

    With truth, residuals of the training runs correlate by more than 0.5 with the next step. Without truth it is a
    question: the given Q and R have a mean NIS above three times the expected one, or the tuned filter predicts
    held-out measurements far worse than a linear regression, `tuning.evaluation.baselines`. Where the mean NIS of
    the tuned filter is in its band, the given Q and R were wrong, and not the model.

    Args:
        problem: has the model.
        comparison: of the tuned filter on it.
        seed: of the study, whose training runs have the residuals.
    """
    untuned, over, reasons = comparison.given, comparison.over_regression, []
    if comparison.tuned.has_truth:
        return _correlation_doubt(problem, seed)
    in_band = NIS_BAND[0] <= nis_ratio(comparison.tuned) <= NIS_BAND[1]
    if untuned is not None and nis_ratio(untuned) > LARGE_NIS and not in_band:
        reasons.append(
            f"with its own Q and R the mean NIS is {untuned.nis.value:.3g} where {untuned.expected_nis:.3g} is "
            "right"
        )
    if is_far_below(over):
        gained = span(Interval(-over.value, -over.high, -over.low), 2)
        reasons.append(
            f"a linear regression on past rows predicts with a log-likelihood {gained} higher a measurement"
        )
    reason = "; ".join(reasons)
    return [f"Is {_model_of(problem)}? {reason[:1].upper()}{reason[1:]}."] if reason else []


def _correlation_doubt(problem: Problem, seed: int) -> list[str]:
    """Residuals of the true states that strongly correlate with the next step, in a sentence in a list."""
    noise = noise_estimation(problem, seed)
    if noise.process_correlation is None or noise.measurement_correlation is None:
        return []
    parts = (
        ("w of", problem.errors, noise.process_correlation),
        ("v of", problem.innovations, noise.measurement_correlation),
    )
    strong = [
        f"{r:+.2g} ({what} {quantity.symbol})"
        for what, quantities, correlation in parts
        for quantity, r in zip(quantities, correlation.tolist(), strict=True)
        if abs(r) > STRONG
    ]
    if not strong:
        return []
    return [
        f"The residuals of the true states correlate with the next step: {', '.join(strong)}, where 0 is right. "
        "The model is wrong there or lacks a state, and no Q and R make up for it: correct it"
        f"{', or estimate a constant (--augment NAME)' if may_estimate_constants(problem) else ''}."
    ]


def _model_of(problem: Problem) -> str:
    """The model of logs as the user named it, with the options that name another one."""
    options = (within(problem).as_mapping() or {}).get("options")
    if options is None:
        return "this model the right one"
    if "model" in options:
        return f"{options['model']} the right model (--model)"
    preset = options.get("preset")
    named = f"{preset}" if preset else f"{logs_package().DEFAULT_PRESET}, the default,"
    return f"{named} the right preset (--preset, or --model)"


def consistency_of(comparison: Comparison) -> tuple[str, Interval, float, str]:
    """NEES, without truth NIS, of the tuned filter: its name, mean and expected value, and a verdict."""
    tuned = comparison.tuned
    if tuned.has_truth:
        name, mean, right = "NEES", tuned.nees, float(len(tuned.rmse))
    else:
        name, mean, right = "NIS", tuned.nis, tuned.expected_nis
    if mean.covers(right) and is_far_below(comparison.over_regression):
        return name, mean, right, MADE_UP
    if mean.covers(right) and any(map(is_beyond, tuned.scored_nees.values())):
        return name, mean, right, JOINTLY
    return name, mean, right, confidence(mean, right)


def number_rows(choices: Sequence[Choice], kind: str, problem: Problem, word: Callable) -> list[list[str]]:
    """Rows of a table of choices' numbers, a column each: a label, and what `word` makes of each number or None.

    The label of Q11 of the thruster is "Q11 [(rad/s)^2]".

    Q11, Q22, ... and such that are the same in every column share a row.

    Args:
        choices: of one kind of filter.
        kind: its name.
        problem: whose parameters have the units.
        word: of a number, or of None where a choice does not say it.
    """
    columns = [parameters_of(choice) for choice in choices]
    units = {parameter.name: parameter.unit for parameter in parameters(kind, problem, **everything_of(problem))}
    names: dict[str, str] = {}
    for name in (name for column in columns for name in column):
        words = index_pairs(name.replace("_", " "))
        names[name] = f"{words} [{units[name]}]" if units.get(name) else words
    rows = []
    for letter in ("", "R "):
        correlations = [name for name in names if name.startswith(f"{letter}correlation ".replace(" ", "_"))]
        if len(correlations) > MOST_CORRELATIONS:
            values = [[_said(column, name) for name in correlations] for column in columns]
            largest = [
                max((value for value in column if value is not None), key=abs, default=None) for column in values
            ]
            rows.append([f"largest of {len(correlations)} {letter or 'Q '}correlations", *map(word, largest)])
            names = {name: label for name, label in names.items() if name not in correlations}
    rows = [[label, *(word(_said(column, name)) for column in columns)] for name, label in names.items()] + rows
    groups: list[list[list[str]]] = []
    for row in rows:
        alike = groups and row[1:] == groups[-1][0][1:] and _letters(row[0]) == _letters(groups[-1][0][0])
        groups[-1].append(row) if alike else groups.append([row])
    return [row for group in groups for row in ([_shared(group)] if len(group) >= ALIKE else group)]


def _said(column: Mapping[str, float], name: str) -> float | None:
    """A number of a choice; where it has none of Q or R, neither has it correlations of these."""
    letter = "R" if name.startswith("R") else "Q"
    tells = "correlation_" not in name or any(re.fullmatch(rf"{letter}\d+", known) for known in column)
    return column.get(name, neutral(name) if tells else None)


def _letters(label: str) -> str | None:
    """What the label of a variance or a correlation begins with and ends with; the whole of all others."""
    match = re.fullmatch(r"(Q|R|correlation |R correlation )\d+(?:[ ,]\d+)?( \[.*\])?", label)
    return f"{match[1]}{match[2]}" if match else label


def _shared(group: Sequence[Sequence[str]]) -> list[str]:
    """One row for several: "Q11 to Q44 [m^2]"."""
    (first, *cells), last = group[0], group[-1][0]
    return [f"{first.partition(' [')[0]} to {last}", *cells]


def apart(*values: float) -> list[str]:
    """Numbers with four significant digits, or enough to distinguish those that differ by more than rounding."""
    for digits in range(4, 9):
        texts = [f"{value:.{digits}g}" for value in values]
        if len(set(texts)) == len({float(f"{value:.8g}") for value in values}):
            break
    return texts
