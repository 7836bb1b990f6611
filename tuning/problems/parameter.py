"""`Parameter`: one number that a study may choose, with its range, its unit and its place in a choice."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from optuna.distributions import FloatDistribution, IntDistribution

from thruster_env.core.checks import at_least, finite, short_repr


class Place(Protocol):
    """Where a number stands in a `Choice`."""

    @property
    def is_variance(self) -> bool:
        """Whether the number is proportional to variances: it doubles where the variance of noise doubles."""

    def get(self, choice) -> float | None:
        """The number, None if the choice does not have it."""

    def set(self, choice, value):
        """The same choice with another number."""


@dataclass(frozen=True)
class Argument:
    """An argument of the problem's model, by name."""

    name: str
    is_variance: bool = False

    def get(self, choice) -> float | None:
        """The argument's value in a choice; None if it has none."""
        return choice.model.get(self.name)

    def set(self, choice, value):
        """The same choice with another value."""
        return choice._replace(model={**choice.model, self.name: value})


@dataclass(frozen=True)
class Parameter:
    """One number that a study may choose.

    Args:
        name: of the trials' parameter; by default the argument of the problem's model, too.
        low: the smallest value.
        high: the largest one.
        unit: the SI unit, for tables.
        log: whether it is chosen on a logarithmic scale.
        integer: whether it is a whole number.
        default: the value before any tuning; the middle of the range on its scale if None.
        first: the part of the range in which a search begins; all of it if None.
        place: where it stands in a choice; the argument of the model of the same name if None.
        tied: places of numbers in proportion to it, and their factors.
        held: places of numbers that have a value whatever this one is.

    Raises:
        ValueError: for an empty range, or a default outside it.
    """

    name: str
    low: float
    high: float
    unit: str = ""
    log: bool = True
    integer: bool = False
    default: float | None = None
    first: tuple[float, float] | None = None
    place: Place = None  # type: ignore[assignment]  # None is replaced as soon as the parameter is made
    tied: tuple[tuple[Place, float], ...] = ()
    held: tuple[tuple[Place, float], ...] = ()

    def __post_init__(self):
        """Check the range and fill in defaults."""
        if not isinstance(self.name, str) or not self.name or " " in self.name:
            raise ValueError(f"a parameter must have a name without spaces, but got {short_repr(self.name)}")
        check = at_least if self.integer else finite
        arguments = (-(10**9),) if self.integer else ()
        for end in ("low", "high"):
            object.__setattr__(self, end, check(f"{end} of {self.name}", getattr(self, end), *arguments))
        if not self.low < self.high or (self.log and self.low <= 0):
            rule = "positive and below high" if self.log else "below high"
            raise ValueError(f"low of {self.name} must be {rule}, but got {self.low:g} and {self.high:g}")
        if self.default is not None:
            default = check(f"default of {self.name}", self.default, *arguments)
            if not self.low <= default <= self.high:
                raise ValueError(
                    f"default of {self.name} must be within {self.low:g} and {self.high:g}, but got {default:g}"
                )
            object.__setattr__(self, "default", default)
        if self.place is None:
            object.__setattr__(self, "place", Argument(self.name))

    @property
    def start(self) -> float | int:
        """The value before any tuning."""
        if self.default is not None:
            return self.default
        middle = math.sqrt(self.low * self.high) if self.log else (self.low + self.high) / 2
        return round(middle) if self.integer else middle

    @property
    def distribution(self) -> FloatDistribution | IntDistribution:
        """The range as Optuna takes it."""
        if self.integer:
            return IntDistribution(int(self.low), int(self.high), log=self.log)
        return FloatDistribution(self.low, self.high, log=self.log)

    def get(self, choice) -> float | None:
        """The number in a choice, None if it does not have it."""
        return self.place.get(choice)

    def set(self, choice, value):
        """The same choice with another number, and what is tied to it."""
        for location, number in self.held:
            choice = location.set(choice, number)
        for location, factor in self.tied:
            choice = location.set(choice, factor * value)
        return self.place.set(choice, value)


def squared(unit: str) -> str:
    """The unit of a variance: "(rad/s)^2" of "rad/s"; empty for a pure number."""
    return f"({unit})^2" if set(unit) & set("/ ^*") else f"{unit}^2" if unit else ""


# Scaled coordinates of free parameters: logarithms of positive parameters, fractions of the range of others.


PART = 0.1  # fraction of its range that is the unit of a parameter on a linear scale


class Coordinates:
    """Map values of p parameters to coordinates (p,) and back; one unit is a sensible change of each parameter.

    That is a factor of e for parameters on a logarithmic scale, a tenth of the range for others.
    """

    def __init__(self, free: Sequence[Parameter]):
        """Raise ValueError unless there are parameters with distinct names."""
        self.free = tuple(free)
        self.names = tuple(parameter.name for parameter in self.free)
        if not self.free or len(set(self.names)) < len(self.names):
            raise ValueError(
                f"free parameters must be some, each named once, but got {short_repr(list(self.names))}"
            )
        if any(parameter.integer for parameter in self.free):
            integers = ", ".join(parameter.name for parameter in self.free if parameter.integer)
            raise ValueError(f"free parameters must not be whole numbers, but got {integers}")
        self.log = np.array([parameter.log for parameter in self.free])
        self.units = np.array(
            [1.0 if parameter.log else PART * (parameter.high - parameter.low) for parameter in self.free]
        )
        self.low, self.high = (
            self.of([parameter.low for parameter in self.free]),
            self.of([parameter.high for parameter in self.free]),
        )

    def of(self, values: Sequence[float] | np.ndarray) -> np.ndarray:
        """Coordinates of values (p,)."""
        array = np.asarray(values, dtype=np.float64)
        return np.where(self.log, np.log(np.where(self.log, array, 1.0)), array) / self.units

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

    def neighbours(self, at: np.ndarray, index: int, step: float) -> tuple[np.ndarray, np.ndarray]:
        """Coordinates a step above and below in one place; at an end of the range both are within it."""
        middle, steps = np.array(at, dtype=np.float64), step * np.eye(len(at))[index]
        middle[index] = np.clip(middle[index], self.low[index] + step, self.high[index] - step)
        return middle + steps, middle - steps

    def start(self, start_values: dict[str, float] | None = None) -> np.ndarray:
        """Coordinates of given values, of the defaults of parameters without; ValueError outside the range."""
        start_values = start_values or {}
        unknown = sorted(set(start_values) - set(self.names))
        if unknown:
            raise ValueError(f"a start must name free parameters, {', '.join(self.names)}, but got {unknown}")
        values = []
        for parameter in self.free:
            value = finite(f"the start of {parameter.name}", start_values.get(parameter.name, parameter.start))
            if not parameter.low <= value <= parameter.high:
                raise ValueError(
                    f"the start of {parameter.name} must be within {parameter.low:g} and "
                    f"{parameter.high:g}, but got {value:g}"
                )
            values.append(value)
        return self.of(values)
