"""The ranges of a study's parameters in words, and parameters at an end of their range."""

from __future__ import annotations

from collections.abc import Mapping
from math import log

from filters.tuned_file import NOISE
from tuning.problems.parameter import Argument, Parameter
from tuning.search.parameters import MeasurementVariance, ProcessVariance, index_pairs
from tuning.search.plan import Plan
from tuning.search.space import Choice

NEAR_END = 0.01  # of a range, on its scale: what ends so near to an end has ended there


def model_ranges(plan: Plan) -> dict[str, Parameter]:
    """The parameters of the model that a study chooses, by name."""
    return {name: one for name, one in plan.parameters().items() if _is_of_model(one)}


def range_words(plan: Plan) -> str:
    """The ranges of the model's parameters in words; empty if none is chosen."""
    parts = [
        f"{index_pairs(name)} {one.low:.3g} to {one.high:.3g} {one.unit}".rstrip()
        for name, one in model_ranges(plan).items()
    ]
    return "; ".join(parts)


def at_ends(choice: Choice, plan: Plan) -> list[str]:
    """A sentence for each parameter of a choice at an end of its range, with advice.

    Given values are not ends, nor are parameters that do not determine the choice's Q and R.
    """
    given: Mapping = plan.scenarios[0].given or {}
    own_noise = plan.scenarios[0].parameters is not None and bool(set(NOISE) & set(choice.model))
    said = []
    for name, one in model_ranges(plan).items():
        value = one.get(choice)
        if value is None or own_noise or value <= 0 < one.low or value == _given_value(one, choice, given):
            continue
        place = _place(value, one)
        if not NEAR_END < place < 1.0 - NEAR_END:
            end, low = ("lower", True) if place <= NEAR_END else ("upper", False)
            told = f"{one.low:.3g} to {one.high:.3g} {one.unit}".rstrip()
            ended = f"{index_pairs(name)} = {value:.3g} ended at the {end} end of its range, {told}"
            said.append(f"{ended}: {_advice(one, low)}.")
    return said


def _is_of_model(one: Parameter) -> bool:
    return isinstance(one.place, ProcessVariance | MeasurementVariance | Argument)


def _given_value(one: Parameter, choice: Choice, given: Mapping) -> float | None:
    return one.get(choice._replace(model=dict(given))) if given else None


def _place(value: float, one: Parameter) -> float:
    """Where a value lies in its range, from 0 to 1 on the range's scale."""
    if one.log:
        return (log(value) - log(one.low)) / (log(one.high) - log(one.low))
    return (value - one.low) / (one.high - one.low)


def _advice(one: Parameter, low: bool) -> str:
    """What to do about a number at an end of its range."""
    if isinstance(one.place, ProcessVariance):
        if low:
            return "the data do not require this noise, and it may be zero"
        return "the model lacks something there; repair it, or estimate a constant (--augment NAME)"
    if isinstance(one.place, MeasurementVariance):
        if low:
            return "the sensor is better than its data sheet, or its readings are smoothed; keep R with --hold-r"
        return "the sensor is far worse than its sheet, or stuck, or its model is wrong; look at its readings"
    return f"give its Parameter a {'lower low' if low else 'higher high'}, if that has a meaning"
