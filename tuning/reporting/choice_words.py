"""The comparison of the best trials with the baselines, and its result, in sentences.

NIS is the normalised innovation squared.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from math import isfinite
from typing import Any

from filters.consistency.intervals import Interval, span
from filters.consistency.verdicts import rounded
from tuning.evaluation.baselines import FULL_Q, FULL_QR, called
from tuning.evaluation.worth import sized
from tuning.search.measures import LEVEL
from tuning.search.objectives import LIKELIHOOD, LOG_SCORE, MOST_PRICE, MSE, PROPER
from tuning.search.validation import choice_from

FULL_NOISE = {FULL_Q: "--full-q", FULL_QR: "--full-q --full-r"}  # by the option that lets it compete with trials


def choice_sentences(found: Mapping[str, Any] | None, plan: Any) -> list[str]:
    """The choice and its reason, the runs in which what was given fails, and what a mean NIS in its band costs.

    Args:
        found: from `tuning.search.validation.as_data`, or of a tuned file; nothing is said of None.
        plan: of the study.
    """
    if not found:
        return []
    met = {one["name"]: one for one in found["met"]}
    candidate, baseline, chosen = found["candidate"], found["baseline"], found["chosen"]
    likely = plan.objectives[0] in PROPER
    over, what = met[candidate]["over"], _what(plan)
    where = f"{len(_range(found['seeds']))} validation {plan.scenarios[0].seed_word}"
    if not found["own_seeds"]:
        where = f"the training {plan.scenarios[0].seed_word}, because there are too few to set some aside"
    best, the, members = f"the best baseline, the {called(baseline)}", _the(candidate), _members(met[chosen])
    if candidate == baseline:
        said = [f"The study returns the {called(baseline)}: every trial is the same filter as a baseline."]
    elif found.get("by_error") and found["by_error"] != chosen:
        said = [_log_score_sentence(met[chosen], met[found["by_error"]], where, what)]
    elif found["gave_way"]:
        lost = met[candidate].get("worse_in")
        without, but = "", ""
        if lost:
            without, but = " without being worse in a log", f", but it is worse in {_listed(lost)}"
        none_is, its = f"{the} is not", f"its {what}"
        if _is_trial(candidate):
            none_is, its = "no trial is", f"{candidate}'s {what}"
        said = [
            f"The study returns the {called(baseline)}{members}: on {where} {none_is} significantly better"
            f"{without} ({its} is {_over(over, likely)}{but})."
        ]
    elif _is_even(over, likely) and met[candidate].get("chance", 1.0) < LEVEL / 2:
        said = [
            f"The study returns {the}: on {where} its {what} is {_over(over, likely, best)}, and it is "
            f"better in most of them (Wilcoxon's signed ranks, p = {met[candidate]['chance']:.2g})."
        ]
    elif _is_even(over, likely):
        said = [
            f"The study returns {the}: on {where} it has the same {what} as {best}, whose mean NIS is "
            "outside its band."
        ]
    else:
        said = [f"The study returns {the}: on {where} its {what} is {_over(over, likely, best)}."]
    said += _sizes_sentence(met, chosen)
    if candidate != chosen and chosen in FULL_NOISE:
        said.append(
            f"Your own parameters cannot express the Q and R of the {called(chosen)}; those of {the} are "
            f"{_own(met[candidate], plan)}."
        )
    channels = len(plan.scenarios[0].quantities.measurements)
    if found.get("failures"):
        said.append(_failures_sentence(found, plan.scenarios[0].seed_word, channels))
    if found["price"] is not None and found["price"] > MOST_PRICE:
        said.append(_price_sentence(found, met[candidate], what, channels))
    if found.get("full"):
        said.append(_full_sentence(found["full"], what, where, likely))
    return said


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


def _log_score_sentence(taken: Mapping, by_error: Mapping, where: str, what: str) -> str:
    """The filter that the log score decided for, beside the one of the least error."""
    names = [_the(one["name"]) for one in (taken, by_error)]
    ratio, gained = taken["value"] / by_error["value"], taken["proper"] - by_error["proper"]
    nees = [_nees_words(one) for one in (taken, by_error)]
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
    same = {name: size for name, one in met.items() if one["choice"]["name"] == kind and (size := _size(one))}
    trials, others = ({size for name, size in same.items() if _is_trial(name) == part} for part in (True, False))
    if len(trials | others) == 1:
        return [f"Trials and baselines have N = {min(trials | others)} members here."]
    if len(trials) == len(others) == 1:
        return [f"Trials have N = {min(trials)} members here, baselines {min(others)}."]
    return []


def _failures_sentence(found: Mapping, word: str, channels: int) -> str:
    """Where what was given fails, and how the best trial does there."""
    failed, runs = found["failed_runs"]
    candidate, tested = found["candidate"], found["tested"]
    named = []
    for one in found["failures"]:
        other = "" if candidate == tested else f"; {_the(candidate)}: {rounded(channels * one['candidate'])}"
        named.append(f"{one['run']} (mean NIS {rounded(channels * one['nis'])}{other})")
    worst = "" if failed == len(named) else "worst "
    return (
        f"The {called(tested)} fails in {failed} of {runs} {word}, {worst}in {_listed(named)}; a mean NIS "
        f"of {channels} is right."
    )


def _price_sentence(found: Mapping, taken: Mapping, what: str, channels: int) -> str:
    """The price of the band, with both sides of the choice."""
    inside = [one for one in found["met"] if one["consistent"] and one["name"].startswith("trial ")]
    best = min(inside, key=lambda one: one["value"])
    has = [
        f"has a {what} of {rounded(one['value'])} and a mean NIS of {rounded(channels * one['nis'])}"
        for one in (best, taken)
    ]
    return (
        f"A mean NIS in its band would cost {100 * found['price']:.3g} % of the {what}, more than the "
        f"{100 * MOST_PRICE:g} % allowed: {best['name']}, the best in the band, {has[0]}. Of the trials within "
        f"{100 * MOST_PRICE:g} % of the best, {taken['name']} has the best log score; it {has[1]}, where "
        f"{channels} is right."
    )


def _over(given: Sequence[float], likely: bool, other: str = "") -> str:
    """A ratio of errors, or a difference of log-likelihoods, in words: over those of `other` if that is named."""
    value, low, high = given
    if likely:
        value, low, high = sized(Interval(-value, -high, -low))
    known = isfinite(low + high)
    if not likely:
        times = f"{span(Interval(value, low, high), 3) if known else format(value, '.3f')} times"
        return f"{times} that of {other}" if other else f"{times} as large"
    ends = [rounded(part) for part in (value, low, high)]
    much = f"{ends[0]} [{ends[1]}, {ends[2]}]" if known and ends[1] != ends[2] else ends[0]
    words = ("above", "higher") if -given[0] >= 0.0 else ("below", "lower")
    return f"{much} {words[0]} that of {other}" if other else f"{much} {words[1]}"


def _own(found: Mapping[str, Any], plan: Any) -> str:
    """The user's own parameters of a validated choice, in words."""
    choice = choice_from(found["choice"])
    values = [(one, one.get(choice)) for one in plan.scenarios[0].parameters]
    return ", ".join(f"{one.name} = {value:.3g} {one.unit}".rstrip() for one, value in values if value is not None)


def _is_even(given: Sequence[float], likely: bool) -> bool:
    return not given[2] < (0.0 if likely else 1.0)


def _what(plan: Any) -> str:
    named = {
        "score": "score",
        MSE: "mean square error",
        LOG_SCORE: "log score",
        LIKELIHOOD: "log-likelihood of a run",
    }
    return named.get(plan.objectives[0], "error")


def _listed(parts: Sequence[str]) -> str:
    return " and ".join([*([", ".join(parts[:-1])] if parts[:-1] else []), parts[-1]])


def _range(ends: Sequence[int]) -> range:
    return range(*ends)
