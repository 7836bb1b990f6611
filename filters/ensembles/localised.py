"""Localisation of ensembles: what lies far apart is not correlated, so that few members do for many states."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from filters.ensembles.ensemble import EnsembleFilter
from thruster_env.core.checks import positive

SUPPORT = (10.0 / 3.0) ** 0.5  # of a taper over its radius: half of what it reaches over


def gaspari_cohn(distance: np.ndarray, radius: float) -> np.ndarray:
    """A taper of distances: nearly exp(-(distance/radius)^2/2), by up to 0.034 more, and 0 from 3.66 radii on.

    With r = distance/(radius (10/3)^1/2) it is 1 - 5/3 r^2 + 5/8 r^3 + r^4/2 - r^5/4 up to r = 1 and r^5/12 -
    r^4/2 + 5/8 r^3 + 5/3 r^2 - 5 r + 4 - 2/(3 r) up to 2: a correlation in up to three dimensions.

    Source: Gaspari, Cohn (1999), "Construction of correlation functions in two and three dimensions", (4.10).
    """
    r = np.asarray(distance) / (radius * SUPPORT)
    near = 1.0 + r**2 * (-5.0 / 3.0 + r * (5.0 / 8.0 + r * (0.5 - 0.25 * r)))
    s = np.maximum(r, 1.0)
    far = 4.0 - 2.0 / (3.0 * s) + s * (-5.0 + s * (5.0 / 3.0 + s * (5.0 / 8.0 + s * (-0.5 + s / 12.0))))
    return np.where(r < 1.0, near, np.where(r < 2.0, far, 0.0))


@dataclass(frozen=True, kw_only=True, eq=False)
class LocalisedFilter(EnsembleFilter):
    """Base of the ensemble filters that may be localised.

    Attributes:
        radius: of the taper by Gaspari and Cohn, in the unit of the model's `positions`; 0 for no localisation.
    """

    radius: float = 0.0

    def __post_init__(self):
        """Check the parameters; raise ValueError that states the rule and the value."""
        super().__post_init__()
        object.__setattr__(self, "radius", positive("radius", self.radius, zero_allowed=True))
        if self.radius and self.model.positions is None:
            raise ValueError(f"radius must be 0 for a model without positions, but got {self.radius:g}")

    @property
    def tapers(self) -> Mapping[str, Any]:
        """Tapers between states and channels, (n, m), and between channels, (m, m); none without a radius."""
        positions = self.model.positions
        if not self.radius or positions is None:
            return {}
        (states, measured, _), distances = positions, positions.distances
        return {
            "taper": gaspari_cohn(distances(states, measured), self.radius),
            "between": gaspari_cohn(distances(measured, measured), self.radius),
        }

    @property
    def parameters(self) -> Mapping[str, Any]:
        """Those of all ensembles, and tapers."""
        return {**super().parameters, **self.tapers}
