"""Scenarios by name or file, and the seeds to learn and to prove with."""

from __future__ import annotations

from numerics.checks import shown
from tuning.problems.scale import computed_scale
from tuning.thruster.excitation import held_levels
from tuning.thruster.files import read_scenario
from tuning.thruster.scenario import FIRST_SCORED_STEP, Data, Scenario
from tuning.thruster.scenarios import SCENARIOS

__all__ = ["FIRST_SCORED_STEP", "SCENARIOS", "Data", "Scenario", "computed_scale", "find_scenario", "held_levels"]


def find_scenario(name: str) -> Scenario:
    """A scenario by its name, or from a file that ends in .toml.

    Raises:
        ValueError: for an unknown name, or a file that `scenario_files.read_scenario` refuses.
    """
    if isinstance(name, str) and name.endswith(".toml"):
        return read_scenario(name, find_scenario)
    if not isinstance(name, str) or name not in SCENARIOS:
        known = ", ".join(SCENARIOS)
        raise ValueError(f"scenario must be one of {known}, or a file that ends in .toml, but got {shown(name)}")
    return SCENARIOS[name]
