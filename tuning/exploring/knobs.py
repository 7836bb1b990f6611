"""The numbers that one may change on a bench, with their ranges and the values that are known for them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

from thruster_env.core.checks import at_least, between, one_of
from tuning.evaluation.baselines import TUNED, baseline_size, baselines
from tuning.problems.parameter import Parameter
from tuning.problems.problem import Problem
from tuning.problems.scenario import BaseScenario, plain
from tuning.search.parameters import PRIOR, Correlation, FilterParameter, MeasurementVariance, ProcessVariance, Q
from tuning.search.space import Choice, everything_of, neutral, parameters, parameters_of

# Disturbances of a scenario as numbers that one may change: outliers, dropout, bias, a dead band.


SENSORS, AMPLIFIER = "sensors", "amplifier"  # fields of a scenario that hold effects
SIGMA = "sigma"  # unit of what is said in standard deviations of the sensor's noise


class Disturbance(NamedTuple):
    """One number of an effect, which is there where the number is positive."""

    name: str
    label: str
    effect: str  # by which `plants.disturbances` or the plant's own effects know it
    argument: str  # of the effect
    high: float
    unit: str
    start: float  # where the scenario has no such effect
    others: tuple[tuple[str, float], ...] = ()  # further arguments of an effect that the scenario does not have
    place: str = SENSORS

    @property
    def adds(self) -> bool:
        """Whether the number brings the effect with it; else it changes one that is there."""
        return self.start == 0.0


DISTURBANCES = (
    Disturbance("outliers", "share of outliers", "outliers", "probability", 0.5, "", 0.0, (("std", 20.0),)),
    Disturbance("outlier_size", "size of outliers", "outliers", "std", 100.0, SIGMA, 20.0),
    Disturbance("dropout", "share of missing measurements", "dropout", "probability", 0.95, "", 0.0),
    Disturbance("bias", "sensor bias", "bias", "std", 20.0, SIGMA, 0.0),
    Disturbance("dead_band", "dead band of the amplifier", "dead-band", "width", 4.0, "V", 0.0, place=AMPLIFIER),
)


@lru_cache(maxsize=32)
def disturbances_of(problem: Problem) -> dict[Disturbance, float]:
    """The disturbances that a problem's plant may have, with their present values; none without a plant."""
    if not isinstance(problem, BaseScenario):
        return {}
    return {
        disturbance: _present(disturbance, problem)
        for disturbance in DISTURBANCES
        if hasattr(problem, disturbance.place)
    }


def disturbed(problem: Problem, values: Mapping[str, float]) -> Problem:
    """The problem with other disturbances, under another name if any differs.

    Args:
        problem: on which it is based; its effects keep all arguments that are not among the values.
        values: by name of the disturbance: sizes in standard deviations of the sensor's noise.
    """
    present = disturbances_of(problem)
    wanted = {disturbance: values.get(disturbance.name, value) for disturbance, value in present.items()}
    if not isinstance(problem, BaseScenario) or all(
        _same(wanted[disturbance], value) for disturbance, value in present.items()
    ):
        return problem
    changes: dict[str, Any] = {}
    deviations = _deviations(problem)
    if any(
        not _same(wanted[disturbance], present[disturbance])
        for disturbance in present
        if disturbance.place == SENSORS
    ):
        changes[SENSORS] = {
            channel: _with(effects, wanted, present, SENSORS, deviation)
            for (channel, effects), deviation in zip(_sensors(problem).items(), deviations, strict=True)
        }
    if any(
        not _same(wanted[disturbance], present[disturbance])
        for disturbance in present
        if disturbance.place == AMPLIFIER
    ):
        changes[AMPLIFIER] = _with(_amplifier(problem), wanted, present, AMPLIFIER, 1.0)
    return problem.replace(name=f"{problem.name} (changed)", **changes)


def _same(value: float, other: float) -> bool:
    return math.isclose(value, other, rel_tol=1e-9, abs_tol=1e-12)


def _with(effects: list[dict], wanted: Mapping, present: Mapping, component: str, deviation: float) -> list[dict]:
    """A chain of effects with the wanted numbers."""
    chain = {effect["name"]: dict(effect) for effect in effects}
    for disturbance, value in wanted.items():
        if disturbance.place != component or (not disturbance.adds and disturbance.effect not in chain):
            continue
        if disturbance.adds and value <= 0.0:
            chain.pop(disturbance.effect, None)
            continue
        unit = deviation if disturbance.unit == SIGMA else 1.0
        if disturbance.effect not in chain:
            sizes = {key: number * deviation for key, number in disturbance.others}
            chain[disturbance.effect] = {"name": disturbance.effect, **sizes}
        elif _same(value, present[disturbance]):
            continue  # to the last digit, and of each channel its own
        chain[disturbance.effect][disturbance.argument] = value * unit
    return list(chain.values())


def _present(disturbance: Disturbance, problem: BaseScenario) -> float:
    """The number as the scenario has it, of the first channel that has the effect."""
    if disturbance.place == AMPLIFIER:
        chains = [(_amplifier(problem), 1.0)]
    else:
        chains = list(zip(_sensors(problem).values(), _deviations(problem), strict=True))
    for effects, deviation in chains:
        for effect in effects:
            if effect["name"] == disturbance.effect:
                value = effect.get(disturbance.argument, disturbance.start)
                return float(value / deviation if disturbance.unit == SIGMA else value)
    return disturbance.start


def _sensors(problem: Any) -> dict[str, list[dict]]:
    """The chain of effects of each channel of a scenario."""
    sensors = plain(problem.sensors)
    by_channel = sensors if isinstance(sensors, Mapping) else {}
    return {channel: list(by_channel.get(channel, [])) for channel in problem.plant.channels}


def _amplifier(problem: Any) -> list[dict]:
    """The chain of effects of a scenario's amplifier."""
    return list(plain(problem.amplifier))


def _deviations(problem: Any) -> list[float]:
    """Standard deviation of each channel's noise."""
    noise_cov = problem.measurement_noise_cov
    variances = noise_cov if isinstance(noise_cov, list | tuple) else [noise_cov]
    return [math.sqrt(variance) for variance in variances]


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
    choices = {label: choice for label, choice in known.items() if label in KNOWN}
    if same is not None:
        choices[TUNED] = same
    return {label: parameters_of(choice) for label, choice in choices.items()}


def knobs_of(name: str, problem: Problem, marks: Mapping[str, Mapping[str, float]]) -> tuple[Knob, ...]:
    """All numbers of a filter that a study may choose, and the disturbances of the plant.

    A variance has the part of a study's range in which its search begins, and what is marked.

    Args:
        name: of the filter.
        problem: what it is on.
        marks: values of knobs, by name, for each label.
    """
    knobs = []
    for parameter in parameters(name, problem, **everything_of(problem)):
        marked = {label: values[parameter.name] for label, values in marks.items() if parameter.name in values}
        low, high = parameter.first or (parameter.low, parameter.high)
        low, high = min([low, *marked.values()]), max([high, *marked.values()])
        label, group = _called(parameter, problem)
        knobs.append(
            Knob(parameter.name, label, parameter.unit, low, high, parameter.log, parameter.integer, group, marked)
        )
    for disturbance, value in disturbances_of(problem).items():
        what, high = disturbance, max(disturbance.high, value)
        knobs.append(Knob(what.name, what.label, what.unit, 0.0, high, False, False, "disturbances", {}))
    return tuple(knobs)


def _called(parameter: Parameter, problem: Problem) -> tuple[str, str]:
    """Label and group of a parameter."""
    position, quantities = parameter.place, problem.quantities
    if isinstance(position, ProcessVariance):
        return f"Q of the {quantities.states[position.index].name}", "Q"
    if isinstance(position, MeasurementVariance):
        return f"R of the {quantities.measurements[position.index].name}", "R"
    if isinstance(position, Correlation):
        return (
            f"correlation in {'Q' if position.covariance == Q else 'R'}, {parameter.name.rpartition('_')[2]}",
            "correlations",
        )
    if position == PRIOR:
        return "factor on the prior covariance", "prior"
    if isinstance(position, FilterParameter):
        return position.name.replace("_", " "), "filter"
    return parameter.name.replace("_", " "), "model"


def start_of(knobs: Sequence[Knob], problem: Problem, choice: Choice) -> dict[str, float]:
    """The value of each knob for a choice on a problem."""
    chosen = parameters_of(choice)
    plant = {disturbance.name: value for disturbance, value in disturbances_of(problem).items()}
    values = {}
    for knob in knobs:
        value = plant.get(knob.name, chosen.get(knob.name, neutral(knob.name)))
        values[knob.name] = knob.low if value is None else value
    return values


def checked_values(
    knobs: Sequence[Knob], values: Mapping[str, float], start: Mapping[str, float]
) -> dict[str, float]:
    """A value of each knob, that at the start where none is given; ValueError for others than a knob can have."""
    known = {knob.name: knob for knob in knobs}
    for name in values:
        one_of("a knob", name, known)
    return {name: knob.checked(values.get(name, start[name])) for name, knob in known.items()}
