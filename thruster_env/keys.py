"""Episode keys of many copies at once, the ones that as many single envs would draw."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from thruster_env.checks import shown
from thruster_env.streams import draw_keys

KEYS_AHEAD = 16  # that a copy draws at a time: a call of its generator costs more than a step


def _of_env(seed: int | None) -> np.random.Generator:
    from gymnasium.utils.seeding import np_random

    return np_random(seed)[0]


class EpisodeKeys:
    """The keys that each copy's own generator draws, one an episode."""

    def __init__(self, count: int, make_generator: Callable[[int | None], np.random.Generator] = _of_env):
        """Take the number of copies, and how a seed makes a generator; there are none before `seed`."""
        self._make_generator = make_generator
        self._generators: list[np.random.Generator | None] = [None] * count
        self._ahead = np.zeros((count, KEYS_AHEAD, 2))
        self._used = np.full(count, KEYS_AHEAD)

    @property
    def seeded(self) -> bool:
        """Whether the copies have generators."""
        return self._generators[0] is not None

    def seed(self, seed: int | list[int | None] | None, mask: np.ndarray) -> None:
        """Give copy i of those in the mask a generator from seed + i, or seed[i]; None keeps the one it has."""
        count = len(self._generators)
        if seed is None or isinstance(seed, (int, np.integer)):
            seeds = [None if seed is None else int(seed) + i for i in range(count)]
        elif len(seed) == count:
            seeds = list(seed)
        else:
            raise ValueError(f"seed must be None, a number or {count} of these, but got {shown(seed)}")
        for i in np.flatnonzero(mask):
            if seeds[i] is not None or self._generators[i] is None:
                self._generators[i] = self._make_generator(seeds[i])
                self._used[i] = KEYS_AHEAD

    def draw(self, which: np.ndarray) -> np.ndarray:
        """The next key (len(which), 2) of some copies."""
        for i in which[self._used[which] == KEYS_AHEAD]:
            self._ahead[i] = draw_keys(self._generators[i], KEYS_AHEAD)
            self._used[i] = 0
        keys = self._ahead[which, self._used[which]]
        self._used[which] += 1
        return keys
