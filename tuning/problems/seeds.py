"""The seeds that a study learns from, chooses an ensemble size on, and is evaluated with."""

from __future__ import annotations

from numerics.checks import at_least

MOST_SEEDS = 20_000  # 500 steps of so many take a gigabyte
SEEDS_APART = 1_000_000  # training seeds of study seed s start at s times this, held-out seeds half-way on ...
SIZES_FROM = SEEDS_APART // 4  # ... and those that choose the ensemble size in between


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
