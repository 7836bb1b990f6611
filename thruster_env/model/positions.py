"""Where the states and the measurements of a model lie: what localisation measures distances between."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from thruster_env.core.checks import as_floats, short_repr


class Positions(NamedTuple):
    """Positions of n states and m measurements, in any unit.

    Attributes:
        states: (n, d), or (n,) along a line.
        measurements: (m, d), or (m,).
        period: of each coordinate, (d,), after which space begins again; infinite, or None for all, without.
    """

    states: Any
    measurements: Any
    period: Any = None

    def checked(self, n: int, m: int) -> Positions:
        """The same as arrays, for so many states and measurements; ValueError if shapes do not fit."""
        states, measurements = (as_floats(part) for part in self[:2])
        states, measurements = (part[:, None] if part.ndim == 1 else part for part in (states, measurements))
        for name, part, count in (("states", states, n), ("measurements", measurements, m)):
            if part.shape != (count, states.shape[-1]) or not np.isfinite(part).all():
                rule = f"({count}, {states.shape[-1]}) finite numbers"
                raise ValueError(f"positions of {name} must be {rule}, but got {short_repr(getattr(self, name))}")
        period = np.full(states.shape[1], np.inf) if self.period is None else as_floats(np.atleast_1d(self.period))
        if period.shape != states.shape[1:] or not (period > 0).all():
            raise ValueError(
                f"period must be {states.shape[1]} positive numbers, but got {short_repr(self.period)}"
            )
        return Positions(states, measurements, period)

    def distances(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """Euclidean distances, the short way round, between positions (k, d) and (l, d), (k, l)."""
        apart = abs(first[:, None] - second) % self.period
        return np.linalg.norm(np.minimum(apart, self.period - apart), axis=-1)
