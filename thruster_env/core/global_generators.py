"""Generators of foreign code: the global ones of Python, NumPy and torch, and those that objects hold."""

from __future__ import annotations

import copy
import random
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from thruster_env.core.streams import HELD_GENERATORS, derived_seed

HELD = (np.random.Generator, np.random.RandomState, random.Random)


class GlobalGenerators:
    """The global generators' states for one owner, unaffected by draws of others in between.

    Before `seed`, `used` leaves them alone. torch is seeded where it has been imported by then, on the CPU.
    """

    def __init__(self):
        self._states: tuple | None = None
        self._within = False

    def seed(self, seed: int) -> None:
        """Start from a seed below 2^32; the global generators stay as they are."""
        before = _states()
        random.seed(seed)
        np.random.seed(seed)
        torch = _torch()
        if torch is not None:
            torch.default_generator.manual_seed(seed)
        self._states = _states()
        if not self._within:
            _set(before)

    @contextmanager
    def used(self) -> Iterator[None]:
        """Within this context the global generators are the owner's; afterwards they are as before."""
        if self._within or self._states is None:
            yield
            return
        before, self._within = _states(), True
        _set(self._states)
        try:
            yield
        finally:
            self._states, self._within = _states(), False
            _set(before)

    def __deepcopy__(self, memo) -> GlobalGenerators:
        """An independent copy; states may be shared because they are never written into."""
        other = GlobalGenerators()
        other._states = self._states
        return other


def _torch() -> Any:
    torch: Any = sys.modules.get("torch")
    return torch if hasattr(torch, "default_generator") else None


def _states() -> tuple:
    torch = _torch()
    return random.getstate(), np.random.get_state(), None if torch is None else torch.get_rng_state()


def _set(states: tuple) -> None:
    pythons, numpys, torchs = states
    random.setstate(pythons)
    np.random.set_state(numpys)
    torch = _torch()
    if torchs is not None and torch is not None:
        torch.set_rng_state(torchs)


def seeded_copy(original: Any, seed: int) -> Any:
    """A deep copy of an object, in which each generator of Python and NumPy gets a new seed."""
    memo: dict = {}
    duplicate = copy.deepcopy(original, memo)
    generators = (part for part in memo.values() if isinstance(part, HELD))
    for number, generator in enumerate({id(generator): generator for generator in generators}.values()):
        generator_seed = derived_seed(seed, HELD_GENERATORS, number)
        if isinstance(generator, np.random.Generator):
            kind: Any = type(generator.bit_generator)
            generator.bit_generator.state = kind(generator_seed).state
        else:
            generator.seed(generator_seed)
    return duplicate
