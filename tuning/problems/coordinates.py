"""Scaled coordinates of free parameters: logarithms of positive parameters, fractions of the range of others."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from thruster_env.core.checks import finite, short_repr
from tuning.problems.parameter import Parameter

PART = 0.1  # fraction of its range that is the unit of a parameter on a linear scale


class Coordinates:
    """Map values of p parameters to coordinates (p,) and back; one unit is a sensible change of each parameter.

    That is a factor of e for parameters on a logarithmic scale, a tenth of the range for others.
    """

    def __init__(self, free: Sequence[Parameter]):
        """Raise ValueError unless there are parameters with distinct names."""
        self.free = tuple(free)
        self.names = tuple(one.name for one in self.free)
        if not self.free or len(set(self.names)) < len(self.names):
            raise ValueError(
                f"free parameters must be some, each named once, but got {short_repr(list(self.names))}"
            )
        if any(one.integer for one in self.free):
            whole = ", ".join(one.name for one in self.free if one.integer)
            raise ValueError(f"free parameters must not be whole numbers, but got {whole}")
        self.log = np.array([one.log for one in self.free])
        self.units = np.array([1.0 if one.log else PART * (one.high - one.low) for one in self.free])
        self.low, self.high = self.of([one.low for one in self.free]), self.of([one.high for one in self.free])

    def of(self, values: Sequence[float] | np.ndarray) -> np.ndarray:
        """Coordinates of values (p,)."""
        given = np.asarray(values, dtype=np.float64)
        return np.where(self.log, np.log(np.where(self.log, given, 1.0)), given) / self.units

    def values(self, at: np.ndarray) -> np.ndarray:
        """Values (p,) at coordinates."""
        at = np.asarray(at) * self.units
        return np.where(self.log, np.exp(np.where(self.log, at, 0.0)), at)

    def named(self, at: np.ndarray) -> dict[str, float]:
        """Values by name."""
        return dict(zip(self.names, self.values(at).tolist(), strict=True))

    def slopes(self, at: np.ndarray) -> np.ndarray:
        """Derivative of each value by its coordinate, (p,)."""
        return np.where(self.log, self.values(at), 1.0) * self.units

    def neighbours(self, at: np.ndarray, place: int, step: float) -> tuple[np.ndarray, np.ndarray]:
        """Coordinates a step above and below in one place; at an end of the range both are within it."""
        middle, steps = np.array(at, dtype=np.float64), step * np.eye(len(at))[place]
        middle[place] = np.clip(middle[place], self.low[place] + step, self.high[place] - step)
        return middle + steps, middle - steps

    def start(self, given: dict[str, float] | None = None) -> np.ndarray:
        """Coordinates of given values, of the defaults of parameters without; ValueError outside the range."""
        given = given or {}
        unknown = sorted(set(given) - set(self.names))
        if unknown:
            raise ValueError(f"a start must name free parameters, {', '.join(self.names)}, but got {unknown}")
        values = []
        for one in self.free:
            value = finite(f"the start of {one.name}", given.get(one.name, one.start))
            if not one.low <= value <= one.high:
                raise ValueError(
                    f"the start of {one.name} must be within {one.low:g} and {one.high:g}, but got {value:g}"
                )
            values.append(value)
        return self.of(values)
