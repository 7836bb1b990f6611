"""Sentences that answer the questions of a comparison, as far as its runs allow."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from filters.consistency.intervals import Interval
from tuning.policies.comparison.plan import BEST, VARIANT_NOISE, WRONG
from tuning.policies.comparison.runs import Result
from tuning.policies.comparison.statistics import as_interval
from tuning.policies.comparison.tables import (
    FILTERED,
    Groups,
    as_text,
    by_policy,
    closed,
    ends_of_gap,
    figure_of,
    name_of,
    percent,
)

GOAL = 0.7  # of the gap between raw and true, at medium noise
NEAR = 0.02  # of the best controller's cost: tolerance within which a learnt policy reaches it
LEARNT = ("ppo", "sac", "ppo+mpc", "sac+mpc")


def answers(results: Sequence[Result]) -> list[str]:
    """Sentences on medium noise."""
    groups = by_policy(results)
    questions = (_goal, _estimates, _learnt, _wrong, _tuned, _wrong_model)
    return [sentence for question in questions for sentence in question(groups)]


def _goal(groups: Groups) -> Iterator[str]:
    gap = ends_of_gap(groups, VARIANT_NOISE)
    found = [figure_of(groups, VARIANT_NOISE, "ppo", observed) for observed in FILTERED]
    parts = [as_interval(closed(figure, *gap)) for figure in found if gap is not None and figure is not None]
    if parts:
        least = min(parts, key=lambda value: value.low)
        said = "reached" if least.low >= GOAL else "not reached by all, intervals counted"
        yield (
            f"At medium noise PPO on filtered state closes at least {percent(least)} of the gap between PPO on "
            f"raw measurements and {name_of(BEST, 'true')}; the aim of {100 * GOAL:.0f} % is {said}."
        )


def _estimates(groups: Groups) -> Iterator[str]:
    """The effect of a better estimate on the same controller, without training."""
    for one, other, said in (
        ("true", "ekf", "knowing the true state"),
        ("ekf, tuned", "ekf, untuned", "tuning the EKF's Q and R, against the rule of thumb,"),
        (
            "ekf, wrong model tuned",
            "ekf, wrong model",
            "tuning them, where the model is wrong, against the plant's",
        ),
        ("ekf", "ekf, wrong model", "a right model"),
    ):
        known, usual = (figure_of(groups, VARIANT_NOISE, BEST, label) for label in (one, other))
        if known is not None and usual is not None:
            value = as_interval(known - usual)
            yield f"With the same controller (MPC), {said} is worth {as_text(value, '+.4f')}: {_verdict(value)}."


def _learnt(groups: Groups) -> Iterator[str]:
    for observed in ("true", "ekf"):
        best = figure_of(groups, VARIANT_NOISE, BEST, observed)
        for kind in LEARNT:
            figure = figure_of(groups, VARIANT_NOISE, kind, observed)
            if best is not None and figure is not None:
                value = as_interval(figure / best)
                cost = as_text(value, ".3f")
                yield f"{name_of(kind, observed)} costs {cost} times as much as MPC: {_near(value)}."


def _wrong(groups: Groups) -> Iterator[str]:
    for variant in WRONG:
        best = figure_of(groups, VARIANT_NOISE, BEST, f"ekf, {variant}")
        for kind in ("ppo", "ppo+mpc"):
            figure = figure_of(groups, VARIANT_NOISE, kind, f"ekf, {variant}")
            if best is not None and figure is not None:
                value = as_interval(figure - best)
                said = f"{name_of(kind, f'ekf, {variant}')} returns {as_text(value, '+.3f')} more than MPC"
                yield f"{said}: {_verdict(value)}."


def _tuned(groups: Groups) -> Iterator[str]:
    for about, one, other, called in (
        ("the exact model", "ekf, tuned", "ekf, untuned", "the untuned one"),
        ("a wrong model", "ekf, wrong model tuned", "ekf, wrong model", "the one with the plant's Q and R"),
    ):
        tuned, reference = (figure_of(groups, VARIANT_NOISE, "ppo", label) for label in (one, other))
        if tuned is not None and reference is not None:
            value = as_interval(tuned - reference)
            yield (
                f"With {about}, PPO on the tuned EKF returns {as_text(value, '+.3f')} more than on {called}: "
                f"{_verdict(value)}."
            )


def _wrong_model(groups: Groups) -> Iterator[str]:
    for observed in ("ekf", "enkf"):
        for kind in ("ppo", BEST):
            wrong = figure_of(groups, VARIANT_NOISE, kind, f"{observed}, wrong model")
            right = figure_of(groups, VARIANT_NOISE, kind, observed)
            if wrong is not None and right is not None:
                value = as_text(as_interval(wrong / right), ".3f")
                yield f"A wrong model multiplies the cost of {name_of(kind, observed)} by {value}."


def _near(value: Interval) -> str:
    if value.high < 1:
        return "better"
    if value.high <= 1 + NEAR:
        return f"within {100 * NEAR:.0f} %"
    return f"not within {100 * NEAR:.0f} %" if value.low > 1 + NEAR else f"perhaps within {100 * NEAR:.0f} %"


def _verdict(value: Interval) -> str:
    if value.low > 0:
        return "better"
    return "worse" if value.high < 0 else "no significant difference"
