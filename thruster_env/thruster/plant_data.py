"""A thruster as data for JSON, for files that record their plant."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

from thruster_env.env import plant_data as data_of_plants
from thruster_env.env.plant_data import Entries, mappings
from thruster_env.thruster.parameters import PRESETS, ThrusterParameters
from thruster_env.thruster.plant import Plant

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
ENTRIES = Entries(ESSENTIAL, PLANT_ENTRIES, ThrusterParameters._fields)


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
        "sensor_effects": {channel: mappings(effects) for channel, effects in plant.sensors.items()},
        "flow": mappings(plant.flow),
        "amplifier": mappings(plant.amplifier),
        "uncertainty": {name: distribution.as_mapping() for name, distribution in plant.uncertainty.items()},
    }
    return json.loads(json.dumps(data))  # lists for tuples, as a file has them


def check_same_plant(tuned_for: Mapping, plant: Plant, file: str | Path) -> list[str]:
    """Raise ValueError, with the differences, if a tuned file is for another plant; return other differences.

    Args:
        tuned_for: the file's data of a plant, from `plant_data`.
        plant: where it is to be used.
        file: its path.
    """
    return data_of_plants.check_same(ENTRIES, tuned_for, plant_data(plant), file)


def differences(then: Mapping, now: Mapping) -> tuple[list[str], list[str]]:
    """What two plants' data differ in: what makes them other plants, and what does not; ValueError for others."""
    return data_of_plants.differences(ENTRIES, then, now)
