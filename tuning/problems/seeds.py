"""The seeds of a study: for training, validation, the choice of the ensemble size, and held-out evaluation."""

from __future__ import annotations

from thruster_env.core.checks import at_least

MOST_SEEDS = 20_000  # runs of 500 steps with so many seeds take a gigabyte
SEEDS_APART = 1_000_000  # training seeds of study seed s start at s times this, held-out seeds half-way on ...
SIZES_FROM = SEEDS_APART // 4  # ... those that choose the ensemble size in between ...
VALIDATION_FROM = 3 * SEEDS_APART // 4  # ... and those on which the best trials meet the baselines behind


def training_seeds(seed: int, count: int) -> range:
    """Training seeds of a study with a given seed."""
    first = at_least("seed", seed, 0) * SEEDS_APART
    return range(first, first + at_least("the number of training seeds", count, 2, SEEDS_APART // 2))


def held_out_seeds(seed: int, count: int) -> range:
    """Held-out seeds of a study with a given seed, which it never uses."""
    first = at_least("seed", seed, 0) * SEEDS_APART + SEEDS_APART // 2
    return range(first, first + at_least("the number of held-out seeds", count, 2, MOST_SEEDS))


def size_seeds(seed: int, count: int) -> range:
    """Seeds on which a study with a given seed chooses the ensemble size, and nothing else."""
    first = at_least("seed", seed, 0) * SEEDS_APART + SIZES_FROM
    return range(first, first + at_least("the number of seeds for the ensemble size", count, 2, MOST_SEEDS))


def validation_seeds(seed: int, count: int) -> range:
    """Seeds on which the best trials of a study with a given seed meet the baselines, and nothing else."""
    first = at_least("seed", seed, 0) * SEEDS_APART + VALIDATION_FROM
    return range(first, first + at_least("the number of validation seeds", count, 2, MOST_SEEDS))
