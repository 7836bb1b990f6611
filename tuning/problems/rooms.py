"""The packages of `tuning` that know a plant, named as text: they are imported when a scenario is looked up."""

from __future__ import annotations

import importlib
from types import ModuleType

# Each has the class Scenario, NAMES of scenarios, the NOMINAL one, find_scenario(name) and
# computed_scale(scenario, sequences).
ROOMS = {"thruster": "tuning.thruster.find", "auv": "tuning.auv.find"}
LOGS = "tuning.thruster.logs"


def room_of(plant: str) -> ModuleType:
    """The package of a plant by its key in `ROOMS`."""
    return importlib.import_module(ROOMS[plant])


def room_of_logs() -> ModuleType:
    """The package of the plant of logs without a model, `tuning.thruster.logs`."""
    return importlib.import_module(LOGS)


def built_in() -> dict[str, ModuleType]:
    """Names of the built-in problems, and the package of each."""
    return {name: room for room in map(room_of, ROOMS) for name in room.NAMES}
