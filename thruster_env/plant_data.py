"""A plant as data that JSON can hold, for files that have to say what plant they are for, and what differs."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path

from numerics.checks import shown
from plants.disturbances.effects import Effect
from thruster_env.parameters import PRESETS, ThrusterParameters
from thruster_env.plant import Plant

# What makes it another plant, on which Q and R mean nothing. The rest disturbs or bounds the same plant.
ESSENTIAL = ("preset", "system", "dt", "sensors")
PLANT_ENTRIES = (
    *ESSENTIAL,
    "parameters",
    "max_voltage",
    "ambient_velocity",
    "process_noise_cov",
    "measurement_noise_cov",
    "sensor_effects",
    "flow",
    "amplifier",
    "uncertainty",
)


def plant_data(plant: Plant) -> dict:
    """What a filter's numbers depend on: the thruster, its sample time, sensors, noise and disturbances.

    Initial state, task and seed are not among it.
    """
    linear = plant.linear
    named = [name for name, parameters in PRESETS.items() if parameters == plant.parameters]
    data = {
        "preset": named[0] if named else None,
        "parameters": plant.parameters._asdict(),
        "system": None if linear is None else [matrix.tolist() for matrix in (linear.a, linear.b, linear.c)],
        "dt": plant.dt,
        "max_voltage": plant.max_voltage,
        "ambient_velocity": plant.ambient_velocity,
        "sensors": list(plant.channels),
        "process_noise_cov": plant.process_noise_cov.tolist(),
        "measurement_noise_cov": plant.measurement_noise_cov.tolist(),
        "sensor_effects": {channel: _mappings(effects) for channel, effects in plant.sensors.items()},
        "flow": _mappings(plant.flow),
        "amplifier": _mappings(plant.amplifier),
        "uncertainty": {name: distribution.as_mapping() for name, distribution in plant.uncertainty.items()},
    }
    return json.loads(json.dumps(data))  # lists for tuples, as a file has them


def check_same_plant(tuned_for: Mapping, plant: Plant, file: str | Path) -> list[str]:
    """Raise ValueError, with what differs, if a tuned file is for another plant; return what else differs.

    Args:
        tuned_for: the file's data of a plant, from `plant_data`.
        plant: where it is to be used.
        file: its path.
    """
    try:
        essential, others = differences(tuned_for, plant_data(plant))
    except ValueError as error:
        raise ValueError(f"{error} (in the tuned file {file})") from None
    if essential:
        raise ValueError(
            f"a tuned file must be for the plant it is put on, but {file} was tuned for {', '.join(essential)}"
        )
    return others


def differences(then: Mapping, now: Mapping) -> tuple[list[str], list[str]]:
    """What two plants' data differ in, each with both values: what makes them other plants, and what does not.

    Raises:
        ValueError: if one of them lacks an entry.
    """
    for data in (then, now):
        if not isinstance(data, Mapping) or set(data) != set(PLANT_ENTRIES):
            raise ValueError(f"a plant's data must have {', '.join(PLANT_ENTRIES)}, but got {shown(data)}")
    entries = [name for name in PLANT_ENTRIES if name not in ("preset", "parameters")]
    differing = [name for name in entries if not _alike(then[name], now[name])]
    essential = [_both(name, then[name], now[name]) for name in differing if name in ESSENTIAL]
    others = [_both(name, then[name], now[name]) for name in differing if name not in ESSENTIAL]
    return _parameters_that_differ(then, now) + essential, others


def _parameters_that_differ(then: Mapping, now: Mapping) -> list[str]:
    """The presets if both have one, else the parameters."""
    one, other = (data["parameters"] if isinstance(data["parameters"], Mapping) else {} for data in (then, now))
    names = [name for name in ThrusterParameters._fields if not _alike(one.get(name), other.get(name))]
    if names and then["preset"] is not None and now["preset"] is not None:
        return [_both("preset", then["preset"], now["preset"])]
    return [_both(name, one.get(name), other.get(name)) for name in names]


def _both(name: str, then, now) -> str:
    return f"{name} {_words(then)} (here {_words(now)})"


def _words(value) -> str:
    listed = isinstance(value, list) and value and all(isinstance(part, str) for part in value)
    return ", ".join(value) if listed else value if isinstance(value, str) else shown(value)


def _alike(one, other) -> bool:
    """Whether two values of JSON are the same but for rounding."""
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        return one.keys() == other.keys() and all(_alike(one[key], other[key]) for key in one)
    if isinstance(one, list) and isinstance(other, list):
        return len(one) == len(other) and all(map(_alike, one, other))
    if isinstance(one, int | float) and isinstance(other, int | float):
        return math.isclose(one, other, rel_tol=1e-9)
    return one == other


def _mappings(effects: tuple[Effect, ...]) -> list[dict]:
    return [effect.as_mapping() for effect in effects]
