"""Scenarios by name or file, and the seeds to learn and to prove with."""

from __future__ import annotations

from thruster_env.checks import at_least, shown
from tuning.excitation import held_levels
from tuning.scale import computed_scale
from tuning.scenario import FIRST_SCORED_STEP, Data, Scenario
from tuning.scenario_files import read_scenario
from tuning.scenario_list import SCENARIOS

__all__ = [
    "FIRST_SCORED_STEP",
    "SCENARIOS",
    "Data",
    "Scenario",
    "computed_scale",
    "find_scenario",
    "held_levels",
    "held_out_seeds",
    "size_seeds",
    "training_seeds",
]

MOST_SEEDS = 20_000  # 500 steps of so many take a gigabyte
SEEDS_APART = 1_000_000  # training seeds of study seed s start at s times this, held-out seeds half-way on ...
SIZES_FROM = SEEDS_APART // 4  # ... and those that choose the ensemble size in between


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


def training_seeds(seed: int, count: int) -> range:
    """Seeds that a study with a given seed learns from."""
    first = at_least("seed", seed, 0) * SEEDS_APART
    return range(first, first + at_least("the number of training seeds", count, 2, SEEDS_APART // 2))


def held_out_seeds(seed: int, count: int) -> range:
    """Seeds that a study with a given seed never sees."""
    first = at_least("seed", seed, 0) * SEEDS_APART + SEEDS_APART // 2
    return range(first, first + at_least("the number of held-out seeds", count, 2, MOST_SEEDS))


def size_seeds(seed: int, count: int) -> range:
    """Seeds that choose the ensemble size of a study with a given seed, and nothing else."""
    first = at_least("seed", seed, 0) * SEEDS_APART + SIZES_FROM
    return range(first, first + at_least("the number of seeds for the ensemble size", count, 2, MOST_SEEDS))
