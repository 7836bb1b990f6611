"""The vehicle's scenarios by name or file, for `tuning.problems.find`."""

from __future__ import annotations

from tuning.auv.scale import computed_scale
from tuning.auv.scenario import Scenario
from tuning.auv.scenarios import SCENARIOS
from tuning.problems.files import find_in

__all__ = ["NAMES", "NOMINAL", "Scenario", "computed_scale", "find_scenario"]
NAMES = tuple(SCENARIOS)
NOMINAL = "auv:motion"


def find_scenario(name: str) -> Scenario:
    """A scenario by its name, or from a file that ends in .toml; ValueError for another."""
    return find_in(SCENARIOS, Scenario, "the vehicle's", name)
