"""The thruster's scenarios by name or file, for `tuning.problems.find`."""

from __future__ import annotations

from tuning.problems.files import find_in
from tuning.thruster.scale import computed_scale
from tuning.thruster.scenario import Scenario
from tuning.thruster.scenarios import SCENARIOS

__all__ = ["NAMES", "NOMINAL", "Scenario", "computed_scale", "find_scenario"]
NAMES = tuple(SCENARIOS)
NOMINAL = "nominal"


def find_scenario(name: str) -> Scenario:
    """A scenario by its name, or from a file that ends in .toml; ValueError for another."""
    return find_in(SCENARIOS, Scenario, "the thruster's", name)
