"""The ranges of a study's parameters in words, and parameters at an end of their range."""

from __future__ import annotations

from collections.abc import Mapping
from math import log
from typing import NamedTuple

from filters.tuned_file import NOISE
from tuning.problems.augmented import may_estimate_constants
from tuning.problems.parameter import Argument, Parameter
from tuning.search.parameters import MeasurementVariance, ProcessVariance, index_pairs
from tuning.search.plan import Plan
from tuning.search.space import Choice

MOST_OPTIONS = 3  # in a sentence
WIDER = 1e4  # factor by which a range is widened, on the advice of a report
NEAR_END = 0.01  # of a range, on its scale: what ends so near to an end has ended there


def model_ranges(plan: Plan) -> dict[str, Parameter]:
    """The parameters of the model that a study chooses, by name."""
    return {name: parameter for name, parameter in plan.parameters().items() if _is_of_model(parameter)}


def range_words(plan: Plan) -> str:
    """The ranges of the model's parameters in words; empty if none is chosen."""
    parts = [
        f"{index_pairs(name)} {parameter.low:.3g} to {parameter.high:.3g} {parameter.unit}".rstrip()
        for name, parameter in model_ranges(plan).items()
    ]
    return "; ".join(parts)


class Ended(NamedTuple):
    """A parameter of a choice at an end of its range."""

    name: str
    parameter: Parameter
    value: float
    low: bool  # whether it is the lower end

    @property
    def wider(self) -> str:
        """The option that widens the range at that end."""
        parameter = self.parameter
        ends = (parameter.low / WIDER, parameter.high) if self.low else (parameter.low, parameter.high * WIDER)
        return f"--where '{self.name} = {ends[0]:.3g}..{ends[1]:.3g}'"


def at_ends(choice: Choice, plan: Plan) -> list[str]:
    """A sentence for each parameter of a choice at an end of its range, with advice."""
    sentences = []
    for reached in _ended(choice, plan):
        parameter, end = reached.parameter, "lower" if reached.low else "upper"
        ends = f"{parameter.low:.3g} to {parameter.high:.3g} {parameter.unit}".rstrip()
        ended = f"{index_pairs(reached.name)} = {reached.value:.3g} ended at the {end} end of its range, {ends}"
        sentences.append(f"{ended}: {_advice(reached, plan)}.")
    return sentences


def _ended(choice: Choice, plan: Plan) -> list[Ended]:
    """The parameters of a choice at an end of their range.

    Given values are not ends, nor are parameters that do not determine the choice's Q and R, nor a Q that
    `--forget` may have raised.
    """
    user_values: Mapping = plan.scenarios[0].given or {}
    own_noise = plan.scenarios[0].parameters is not None and bool(set(NOISE) & set(choice.model))
    reached = []
    for name, parameter in model_ranges(plan).items():
        value, raised = (
            parameter.get(choice),
            plan.forget is not None and isinstance(parameter.place, ProcessVariance),
        )
        if value is None or own_noise or raised or value <= 0 < parameter.low:
            continue
        if value == _given_value(parameter, choice, user_values):
            continue
        part = _part(value, parameter)
        if not NEAR_END < part < 1.0 - NEAR_END:
            reached.append(Ended(name, parameter, value, part <= NEAR_END))
    return reached


def range_warning(choice: Choice, plan: Plan) -> list[str]:
    """The end of the search in a sentence, in a list, if Q or R of a choice is as large as its range allows.

    If the Q and R from which the ranges follow are far too small, the filter looks as if its model were wrong.
    """
    high = [
        reached
        for reached in _ended(choice, plan)
        if not reached.low and not isinstance(reached.parameter.place, Argument)
    ]
    if not high:
        return []
    names, more = [index_pairs(reached.name) for reached in high], len(high) - MOST_OPTIONS
    options = " ".join(reached.wider for reached in high[:MOST_OPTIONS]) + (
        f" and {more} more" if more > 0 else ""
    )
    listed = " and ".join([*([", ".join(names[:-1])] if names[:-1] else []), names[-1]])
    ends = "the upper end of its range" if len(names) == 1 else "the upper ends of their ranges"
    return [
        f"{listed} ended at {ends}, given by the Q and R with which the study began. Before you doubt the model, "
        f"widen the range: {options}."
    ]


def _is_of_model(parameter: Parameter) -> bool:
    return isinstance(parameter.place, ProcessVariance | MeasurementVariance | Argument)


def _given_value(parameter: Parameter, choice: Choice, user_values: Mapping) -> float | None:
    return parameter.get(choice._replace(model=dict(user_values))) if user_values else None


def _part(value: float, parameter: Parameter) -> float:
    """Where a value lies in its range, from 0 to 1 on the range's scale."""
    if parameter.log:
        return (log(value) - log(parameter.low)) / (log(parameter.high) - log(parameter.low))
    return (value - parameter.low) / (parameter.high - parameter.low)


def _advice(reached: Ended, plan: Plan) -> str:
    """What to do about a parameter at an end of its range."""
    location, low = reached.parameter.place, reached.low
    if isinstance(location, Argument):
        return f"give its Parameter a {'lower low' if low else 'higher high'}, if that has a meaning"
    if isinstance(location, ProcessVariance):
        if low:
            return "the data do not require this noise, and it may be zero"
        cause = "the model lacks something there: repair it"
        if may_estimate_constants(plan.scenarios[0]):
            cause += ", or estimate a constant (--augment NAME)"
    elif low:
        cause = "the sensor is better than its data sheet, or its readings are smoothed: keep R with --hold-r"
    else:
        cause = "the sensor is far worse than its sheet, or stuck, or its model is wrong: look at its readings"
    return f"widen the range ({reached.wider}). If it ends at the new end, too, {cause}"
