"""Episode keys of a vector env: copy i gets the keys that a single env with its seed would draw."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from thruster_env.core.checks import options as checked_options
from thruster_env.core.checks import seed as checked_seed
from thruster_env.core.checks import short_repr
from thruster_env.core.streams import draw_keys

KEYS_AHEAD = 16  # that a copy draws at a time: a call of its generator costs more than a step


def _of_env(seed: int | None) -> np.random.Generator:
    from gymnasium.utils.seeding import np_random

    return np_random(seed)[0]


class EpisodeKeys:
    """The keys that each copy's own generator draws, one an episode."""

    def __init__(self, count: int, make_generator: Callable[[int | None], np.random.Generator] = _of_env):
        self._make_generator = make_generator
        self._generators: list[np.random.Generator | None] = [None] * count
        self._ahead = np.zeros((count, KEYS_AHEAD, 2))
        self._used = np.full(count, KEYS_AHEAD)
        self.seeded = False  # whether all copies have generators: asked at every step, so it is remembered

    @property
    def count(self) -> int:
        """Number of copies."""
        return len(self._generators)

    def seed(self, seed: int | list[int | None] | None, mask: np.ndarray) -> None:
        """Give copy i of those in the mask a generator from seed + i, or seed[i]; None keeps the one it has."""
        seeds = self.seeds(seed)
        for i in np.flatnonzero(mask):
            if seeds[i] is not None or self._generators[i] is None:
                self._generators[i] = self._make_generator(seeds[i])
                self._used[i] = KEYS_AHEAD
        self.seeded = None not in self._generators

    def seeds(self, seed) -> list[int | None]:
        """The seed of each copy; ValueError unless a reset's seed is None, a number, or one of these a copy."""
        count = self.count
        if isinstance(seed, (list, tuple)) or (isinstance(seed, np.ndarray) and seed.ndim == 1):
            if len(seed) != count:
                raise ValueError(f"seed must be None, a number or {count} of these, but got {short_repr(seed)}")
            return [checked_seed(entry) for entry in seed]
        first = checked_seed(seed)
        return [None if first is None else first + i for i in range(count)]

    def draw(self, which: np.ndarray) -> np.ndarray:
        """The next key (len(which), 2) of some copies."""
        for i in which[self._used[which] == KEYS_AHEAD]:
            self._ahead[i] = draw_keys(self._generators[i], KEYS_AHEAD)
            self._used[i] = 0
        keys = self._ahead[which, self._used[which]]
        self._used[which] += 1
        return keys


def reset_mask(options: Mapping | None, keys: EpisodeKeys) -> np.ndarray | None:
    """The copies that a reset's options restart, (count,) booleans; None for all.

    Raises ValueError for other options, and for a mask that leaves out copies that have never been reset.
    """
    mask, count = checked_options(options).get("reset_mask"), keys.count
    if mask is None:
        return None
    try:
        chosen = np.asarray(mask)
    except ValueError:  # rows of different lengths
        chosen = np.empty(0)
    if chosen.shape != (count,) or chosen.dtype != np.bool_ or not chosen.any():
        rule = f"reset_mask must be {count} booleans, at least one of them true"
        raise ValueError(f"{rule}, but got {short_repr(mask)}")
    if not keys.seeded and not chosen.all():
        raise ValueError(f"reset_mask must have all copies at the first reset, but got {short_repr(mask)}")
    return chosen.copy()
