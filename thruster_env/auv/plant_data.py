"""A vehicle as data for JSON, for files that record their plant."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

from thruster_env.auv.parameters import VehicleParameters
from thruster_env.auv.plant import Plant
from thruster_env.auv.presets import PRESETS
from thruster_env.env.plant_data import Entries, check_same, mappings

ENTRIES = Entries(
    ("preset", "dt", "sensors", "propeller_torque"),
    (
        "preset",
        "parameters",
        "dt",
        "sensors",
        "propeller_torque",
        "max_thrust",
        "max_plane",
        "process_noise_cov",
        "measurement_noise_cov",
        "sensor_effects",
        "current",
        "propeller_lag",
        "plane_lag",
    ),
    VehicleParameters._fields,
)


def plant_data(plant: Plant) -> dict:
    """What a filter's numbers depend on: the vehicle, its sample time, sensors, noise, current and lags.

    Initial state, task and seed are not among it.
    """
    named = [name for name, parameters in PRESETS.items() if parameters == plant.parameters]
    data = {
        "preset": named[0] if named else None,
        "parameters": plant.parameters._asdict(),
        "dt": plant.dt,
        "sensors": list(plant.channels),
        "propeller_torque": plant.propeller_torque,
        "max_thrust": plant.max_thrust,
        "max_plane": plant.max_plane,
        "process_noise_cov": plant.process_noise_cov.tolist(),
        "measurement_noise_cov": plant.measurement_noise_cov.tolist(),
        "sensor_effects": {channel: mappings(effects) for channel, effects in plant.sensors.items()},
        "current": {direction: mappings(signals) for direction, signals in plant.current.items()},
        "propeller_lag": plant.propeller_lag,
        "plane_lag": plant.plane_lag,
    }
    return json.loads(json.dumps(data))  # lists for tuples, as a file has them


def check_same_plant(tuned_for: Mapping, plant: Plant, file: str | Path) -> list[str]:
    """Raise ValueError, with the differences, if a tuned file is for another plant; return other differences.

    Args:
        tuned_for: the file's data of a plant, from `plant_data`.
        plant: where it is to be used.
        file: its path.
    """
    return check_same(ENTRIES, tuned_for, plant_data(plant), file)
