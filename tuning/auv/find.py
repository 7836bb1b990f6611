"""The vehicle's scenarios by name or file, as `tuning.problems.find` is told of them."""

from __future__ import annotations

from numerics.checks import shown
from tuning.auv.scale import computed_scale
from tuning.auv.scenario import Scenario
from tuning.auv.scenarios import SCENARIOS
from tuning.problems.files import read_scenario

__all__ = ["NAMES", "NOMINAL", "Scenario", "computed_scale", "find_scenario"]
NAMES = tuple(SCENARIOS)
NOMINAL = "auv:motion"


def find_scenario(name: str) -> Scenario:
    """A scenario by its name, or from a file that ends in .toml.

    Raises:
        ValueError: for an unknown name, a file that `read_scenario` refuses, or one of another plant.
    """
    if isinstance(name, str) and name.endswith(".toml"):
        found = read_scenario(name)
        if not isinstance(found, Scenario):
            raise ValueError(f"scenario must be a vehicle's, but {name} is of plant {found.plant_kind!r}")
        return found
    if not isinstance(name, str) or name not in SCENARIOS:
        known = ", ".join(SCENARIOS)
        raise ValueError(f"scenario must be one of {known}, or a file that ends in .toml, but got {shown(name)}")
    return SCENARIOS[name]
