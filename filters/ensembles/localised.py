"""Localisation of ensembles: what lies far apart is not correlated, so that few members do for many states."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from filters.engine.belief import Kernels
from filters.ensembles.by_parts import kernels_by_parts
from filters.ensembles.ensemble import EnsembleFilter
from thruster_env.numerics.checks import positive, shown

SUPPORT = (10.0 / 3.0) ** 0.5  # of a taper over its radius: half of what it reaches over
LEAST = 1e-3  # tapers below are zero where each state has an analysis of its own


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
        """Tapers between states and channels, (n, m), and between channels, (m, m)."""
        states, measured, _ = self.model.positions
        distances = self.model.positions.distances
        return {
            "taper": gaspari_cohn(distances(states, measured), self.radius),
            "between": gaspari_cohn(distances(measured, measured), self.radius),
        }

    @property
    def parameters(self) -> Mapping[str, Any]:
        """Those of all ensembles, and tapers if there is a radius."""
        return {**super().parameters, **(self.tapers if self.radius else {})}


@dataclass(frozen=True, kw_only=True, eq=False)
class LocalisedByParts(LocalisedFilter):
    """Base of those whose update goes through states or channels, if there is a radius.

    Such an update needs a diagonal R that is the same in all steps, and is neither in C nor on tensors.
    """

    serial: ClassVar[bool]  # whether it goes through channels

    def __post_init__(self):
        """Check the parameters and R; raise ValueError that states the rule and the value."""
        super().__post_init__()
        r = self.model.measurement_noise_cov
        if self.radius and (r != np.diag(np.diag(r))).any():
            raise ValueError(f"R must be diagonal where radius is not 0, but got {shown(r.tolist())}")

    @property
    def by_parts(self) -> bool:
        """Whether the update is by parts."""
        return bool(self.radius)

    @property
    def varying_noise(self) -> bool:  # type: ignore[override]
        """Whether Q and R may differ from step to step."""
        return not self.radius

    @property
    def tapers(self) -> Mapping[str, Any]:
        """Tapers between states and channels, (n, m)."""
        taper = super().tapers["taper"]
        return {"taper": np.where(taper > LEAST, taper, 0.0)}

    def kernels(self) -> Kernels:
        """Kernels for the model's functions; see `Filter.kernels`."""
        if not self.radius:
            return super().kernels()
        page, model = self.page_with(self.inflation != 1.0, relaxation=False), self.kernel_model
        return kernels_by_parts(page, model.functions, model.shape, self.serial)
