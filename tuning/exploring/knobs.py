"""The numbers that one may change on a bench, with their ranges and the values that are known for them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from thruster_env.core.checks import at_least, between, one_of
from tuning.evaluation.baselines import TUNED, baseline_size, baselines
from tuning.exploring.disturbed import disturbances_of
from tuning.problems.parameter import Parameter
from tuning.problems.problem import Problem
from tuning.search.filter_parameters import FilterParameter
from tuning.search.parameters import PRIOR, Correlation, MeasurementVariance, ProcessVariance, Q
from tuning.search.space import Choice, everything_of, neutral, parameters, parameters_of

KNOWN = ("given", "rule of thumb", "scaled default", "oracle")  # baselines that are marked
GROUPS = ("Q", "R", "model", "filter", "prior", "correlations", "disturbances")


class Knob(NamedTuple):
    """A number that one may change."""

    name: str  # that of a trial's parameter, or of a disturbance
    label: str
    unit: str
    low: float
    high: float
    log: bool
    integer: bool
    group: str  # one of `GROUPS`
    marks: Mapping[str, float]  # where baselines and the tuned filter have it

    def checked(self, value) -> float:
        """The value; ValueError unless it is a number within the range, of whole numbers a whole one."""
        number = between(self.name, value, self.low, self.high, self.unit)
        return at_least(self.name, value, int(self.low)) if self.integer else number


def marks_of(name: str, problem: Problem, tuned: Choice | None = None, seed: int = 0) -> dict[str, dict]:
    """The values of knobs, by name, of a filter's baselines and of a tuned filter."""
    same = tuned if tuned is not None and tuned.name == name else None
    known = baselines(name, problem, seed, ensemble_size=None if same is None else baseline_size(same))
    found = {label: one for label, one in known.items() if label in KNOWN}
    if same is not None:
        found[TUNED] = same
    return {label: parameters_of(choice) for label, choice in found.items()}


def knobs_of(name: str, problem: Problem, marks: Mapping[str, Mapping[str, float]]) -> tuple[Knob, ...]:
    """All numbers of a filter that a study may choose, and the disturbances of the plant.

    A variance has the part of a study's range in which its search begins, and what is marked.

    Args:
        name: of the filter.
        problem: what it is on.
        marks: values of knobs, by name, for each label.
    """
    found = []
    for one in parameters(name, problem, **everything_of(problem)):
        own = {label: values[one.name] for label, values in marks.items() if one.name in values}
        low, high = one.first or (one.low, one.high)
        low, high = min([low, *own.values()]), max([high, *own.values()])
        label, group = _called(one, problem)
        found.append(Knob(one.name, label, one.unit, low, high, one.log, one.integer, group, own))
    for disturbance, value in disturbances_of(problem).items():
        what, high = disturbance, max(disturbance.high, value)
        found.append(Knob(what.name, what.label, what.unit, 0.0, high, False, False, "disturbances", {}))
    return tuple(found)


def _called(one: Parameter, problem: Problem) -> tuple[str, str]:
    """Label and group of a parameter."""
    place, quantities = one.place, problem.quantities
    if isinstance(place, ProcessVariance):
        return f"Q of the {quantities.states[place.index].name}", "Q"
    if isinstance(place, MeasurementVariance):
        return f"R of the {quantities.measurements[place.index].name}", "R"
    if isinstance(place, Correlation):
        return (
            f"correlation in {'Q' if place.covariance == Q else 'R'}, {one.name.rpartition('_')[2]}",
            "correlations",
        )
    if place == PRIOR:
        return "factor on the prior covariance", "prior"
    if isinstance(place, FilterParameter):
        return place.name.replace("_", " "), "filter"
    return one.name.replace("_", " "), "model"


def start_of(knobs: Sequence[Knob], problem: Problem, choice: Choice) -> dict[str, float]:
    """The value of each knob for a choice on a problem."""
    own, plant = parameters_of(choice), {one.name: value for one, value in disturbances_of(problem).items()}
    found = {}
    for knob in knobs:
        value = plant.get(knob.name, own.get(knob.name, neutral(knob.name)))
        found[knob.name] = knob.low if value is None else value
    return found


def checked_values(
    knobs: Sequence[Knob], values: Mapping[str, float], start: Mapping[str, float]
) -> dict[str, float]:
    """A value of each knob, that at the start where none is given; ValueError for others than a knob can have."""
    known = {knob.name: knob for knob in knobs}
    for name in values:
        one_of("a knob", name, known)
    return {name: knob.checked(values.get(name, start[name])) for name, knob in known.items()}
