"""The packages of `tuning` that know a plant, named as text: they are imported when a scenario is looked up."""

from __future__ import annotations

import importlib
from types import ModuleType

# Each has the class Scenario, NAMES of scenarios, the NOMINAL one, find_scenario(name) and
# computed_scale(scenario, sequences).
PLANT_PACKAGES = {"thruster": "tuning.thruster.scenario", "auv": "tuning.auv.scenario"}
LOGS = "tuning.thruster.logs"


def plant_package(plant: str) -> ModuleType:
    """The package of a plant by its key in `PLANT_PACKAGES`."""
    return importlib.import_module(PLANT_PACKAGES[plant])


def logs_package() -> ModuleType:
    """The package of the plant of logs without a model, `tuning.thruster.logs`."""
    return importlib.import_module(LOGS)


def built_in() -> dict[str, ModuleType]:
    """Names of the built-in problems, and the package of each."""
    return {name: room for room in map(plant_package, PLANT_PACKAGES) for name in room.NAMES}
