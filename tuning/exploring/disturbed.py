"""Disturbances of a scenario as numbers that one may change: outliers, dropout, bias, a dead band."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import lru_cache
from typing import Any, NamedTuple

from tuning.problems.plain import plain
from tuning.problems.problem import Problem
from tuning.problems.scenario import BaseScenario

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
    return {one: _present(one, problem) for one in DISTURBANCES if hasattr(problem, one.place)}


def disturbed(problem: Problem, values: Mapping[str, float]) -> Problem:
    """The problem with other disturbances, under another name if any differs.

    Args:
        problem: on which it is based; its effects keep all arguments that are not among the values.
        values: by name of the disturbance: sizes in standard deviations of the sensor's noise.
    """
    present = disturbances_of(problem)
    wanted = {one: values.get(one.name, value) for one, value in present.items()}
    if not isinstance(problem, BaseScenario) or all(_same(wanted[one], value) for one, value in present.items()):
        return problem
    changes: dict[str, Any] = {}
    deviations = _deviations(problem)
    if any(not _same(wanted[one], present[one]) for one in present if one.place == SENSORS):
        changes[SENSORS] = {
            channel: _with(effects, wanted, present, SENSORS, deviation)
            for (channel, effects), deviation in zip(_sensors(problem).items(), deviations, strict=True)
        }
    if any(not _same(wanted[one], present[one]) for one in present if one.place == AMPLIFIER):
        changes[AMPLIFIER] = _with(_amplifier(problem), wanted, present, AMPLIFIER, 1.0)
    return problem.replace(name=f"{problem.name} (changed)", **changes)


def _same(value: float, other: float) -> bool:
    return math.isclose(value, other, rel_tol=1e-9, abs_tol=1e-12)


def _with(effects: list[dict], wanted: Mapping, present: Mapping, place: str, deviation: float) -> list[dict]:
    """A chain of effects with the wanted numbers."""
    chain = {one["name"]: dict(one) for one in effects}
    for one, value in wanted.items():
        if one.place != place or (not one.adds and one.effect not in chain):
            continue
        if one.adds and value <= 0.0:
            chain.pop(one.effect, None)
            continue
        unit = deviation if one.unit == SIGMA else 1.0
        if one.effect not in chain:
            sizes = {key: number * deviation for key, number in one.others}
            chain[one.effect] = {"name": one.effect, **sizes}
        elif _same(value, present[one]):
            continue  # to the last digit, and of each channel its own
        chain[one.effect][one.argument] = value * unit
    return list(chain.values())


def _present(one: Disturbance, problem: BaseScenario) -> float:
    """The number as the scenario has it, of the first channel that has the effect."""
    if one.place == AMPLIFIER:
        chains = [(_amplifier(problem), 1.0)]
    else:
        chains = list(zip(_sensors(problem).values(), _deviations(problem), strict=True))
    for effects, deviation in chains:
        for effect in effects:
            if effect["name"] == one.effect:
                value = effect.get(one.argument, one.start)
                return float(value / deviation if one.unit == SIGMA else value)
    return one.start


def _sensors(problem: Any) -> dict[str, list[dict]]:
    """The chain of effects of each channel of a scenario."""
    given = plain(problem.sensors)
    own = given if isinstance(given, Mapping) else {}
    return {channel: list(own.get(channel, [])) for channel in problem.plant.channels}


def _amplifier(problem: Any) -> list[dict]:
    """The chain of effects of a scenario's amplifier."""
    return list(plain(problem.amplifier))


def _deviations(problem: Any) -> list[float]:
    """Standard deviation of each channel's noise."""
    given = problem.measurement_noise_cov
    variances = given if isinstance(given, list | tuple) else [given]
    return [math.sqrt(variance) for variance in variances]
