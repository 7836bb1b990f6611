"""Uncertain parameters: factors on a preset's values, drawn once per episode from its key."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import Field, asdict, dataclass
from typing import Any, ClassVar

import numpy as np

from thruster_env.core.checks import one_of, positive, short_repr
from thruster_env.core.streams import PARAMETERS, normal_block, uniform_block
from thruster_env.effects.effects import set_field
from thruster_env.thruster.parameters import ThrusterParameters, checked

UNCERTAIN = tuple(name for name in ThrusterParameters._fields if name not in ("angles", "thrust_asymmetry"))


class _Distribution:
    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]  # every distribution is a dataclass
    name: ClassVar[str]

    def as_mapping(self) -> dict:
        """The distribution as JSON can hold it: its name and its arguments."""
        return {"name": self.name, **asdict(self)}


@dataclass(frozen=True)
class Uniform(_Distribution):
    """A factor drawn uniformly from `low` to `high`."""

    low: float
    high: float
    name: ClassVar[str] = "uniform"

    def __post_init__(self):
        """Check the arguments."""
        low, high = positive("low", self.low), positive("high", self.high)
        if low > high:
            raise ValueError(f"low must be at most high, but got {self.low!r} and {self.high!r}")
        set_field(self, "low", low)
        set_field(self, "high", high)

    def factors(self, number: int, keys: np.ndarray) -> np.ndarray:
        """Factors of the number-th uncertain parameter for keys (B, 2), shape (B,)."""
        u = uniform_block(number, 0, PARAMETERS, keys[:, 0].astype(np.uint64), keys[:, 1].astype(np.uint64))[0]
        return self.low + (self.high - self.low) * u

    @property
    def extremes(self) -> tuple[float, float]:
        """Smallest and largest factor for which the integration must be accurate."""
        return self.low, self.high


@dataclass(frozen=True)
class LogNormal(_Distribution):
    """A factor exp(std n) with a standard normal n: a relative uncertainty of about `std`."""

    std: float
    name: ClassVar[str] = "log-normal"

    def __post_init__(self):
        """Check the argument."""
        std = positive("std", self.std, zero_allowed=True)
        if std > 2:
            raise ValueError(
                f"std must be at most 2, a factor of 7 at one standard deviation, but got {self.std!r}"
            )
        set_field(self, "std", std)

    def factors(self, number: int, keys: np.ndarray) -> np.ndarray:
        """Factors of the number-th uncertain parameter for keys (B, 2), shape (B,)."""
        n = normal_block(number, 0, PARAMETERS, keys[:, 0].astype(np.uint64), keys[:, 1].astype(np.uint64))[0]
        return np.exp(self.std * n)

    @property
    def extremes(self) -> tuple[float, float]:
        """Smallest and largest factor for which the integration must be accurate: three standard deviations."""
        return math.exp(-3 * self.std), math.exp(3 * self.std)


DISTRIBUTIONS = {cls.name: cls for cls in (Uniform, LogNormal)}


def make_uncertainty(uncertainty) -> dict[str, Uniform | LogNormal]:
    """Distributions by parameter from None or a mapping such as {"load_gain": {"name": "uniform", ...}}.

    Raises ValueError if an argument is wrong; the message states the rule and the value.
    """
    if uncertainty is None:
        return {}
    if not isinstance(uncertainty, Mapping):
        raise ValueError(
            f"uncertainty must be a mapping from parameters to distributions, but got {short_repr(uncertainty)}"
        )
    distributions = {}
    for parameter, distribution in uncertainty.items():
        one_of("a name in uncertainty", parameter, UNCERTAIN)
        distributions[parameter] = distribution
        if isinstance(distribution, (Uniform, LogNormal)):
            continue
        names = ", ".join(DISTRIBUTIONS)
        rule = f"the distribution of {parameter} must be a mapping with arguments and a name out of {names}"
        if not isinstance(distribution, Mapping) or distribution.get("name") not in tuple(DISTRIBUTIONS):
            raise ValueError(f"{rule}, but got {short_repr(distribution)}")
        arguments = {key: value for key, value in distribution.items() if key != "name"}
        try:
            distributions[parameter] = DISTRIBUTIONS[distribution["name"]](**arguments)
        except TypeError:
            raise ValueError(f"{rule}, but got {short_repr(distribution)}") from None
    return distributions


def drawn_parameters(nominal: ThrusterParameters, uncertainty: Mapping, keys: np.ndarray) -> ThrusterParameters:
    """Parameters of the episodes with keys (B, 2): the uncertain ones as arrays (B,), the others numbers.

    A parameter's draw depends on the key and on the parameter, not on which others are uncertain.
    """
    drawn = {
        name: getattr(nominal, name) * distribution.factors(UNCERTAIN.index(name), keys)
        for name, distribution in uncertainty.items()
    }
    return nominal._replace(**drawn)


def extreme_parameters(nominal: ThrusterParameters, uncertainty: Mapping) -> list[ThrusterParameters]:
    """The nominal parameters and corners of the region they are drawn from, which bound the integration's step.

    All corners for up to five uncertain parameters; of more, those with one parameter or all of them extreme.
    """
    names = list(uncertainty)
    if len(names) <= 5:
        corners = list(itertools.product(*(uncertainty[name].extremes for name in names)))
    else:
        ends = [uncertainty[name].extremes for name in names]
        corners = [tuple(end[side] for end in ends) for side in (0, 1)]
        corners += [
            tuple(end[side] if i == k else 1.0 for i, end in enumerate(ends))
            for k in range(len(names))
            for side in (0, 1)
        ]
    scaled = (
        {name: getattr(nominal, name) * factor for name, factor in zip(names, corner, strict=True)}
        for corner in corners
    )
    return [nominal, *(checked(nominal._replace(**values)) for values in scaled if values)]
