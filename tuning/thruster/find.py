"""The thruster's scenarios by name or file, as `tuning.problems.find` is told of them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from numerics.checks import shown
from tuning.thruster.files import read_scenario, scenario_of
from tuning.thruster.scenario import Scenario
from tuning.thruster.scenarios import SCENARIOS

NAMES = tuple(SCENARIOS)


def find_scenario(name: str) -> Scenario:
    """A scenario by its name, or from a file that ends in .toml.

    Raises:
        ValueError: for an unknown name, or a file that `files.read_scenario` refuses.
    """
    if isinstance(name, str) and name.endswith(".toml"):
        return read_scenario(name, find_scenario)
    if not isinstance(name, str) or name not in SCENARIOS:
        known = ", ".join(SCENARIOS)
        raise ValueError(f"scenario must be one of {known}, or a file that ends in .toml, but got {shown(name)}")
    return SCENARIOS[name]


def from_mapping(content: Mapping, name: str, file: str | Path) -> Scenario:
    """The scenario that a file holds as data; see `files.scenario_of`."""
    return scenario_of(content, name, file)
