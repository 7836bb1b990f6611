"""Ensemble filters without perturbed measurements, and the one with half the gain: the deterministic EnKF."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from filters.algebra.operations import divide
from filters.engine.belief import Kernels
from filters.ensembles.ensemble import EnsembleFilter
from filters.ensembles.localised import LocalisedFilter
from filters.ensembles.rotation import with_rotation
from filters.ensembles.steps import advance, compare, settle
from filters.pages.page_filter import Page
from thruster_env.core.checks import switch


def update(model, x, z, e):
    """The measurement z; channels that are NaN are missing."""
    d, C, v, S, _, level = compare(model, x, z)
    return x + divide(C, S) @ (v - d * 0.5), v, S, level


@dataclass(frozen=True, kw_only=True, eq=False)
class DeterministicUpdateFilter(EnsembleFilter):
    """Base of the ensemble filters whose update draws nothing.

    Attributes:
        rotations: 1 for a random rotation of the members about their mean after each update, 0 for none. It keeps
            them from growing outliers where little or no process noise mixes them.
    """

    rotations: int = 0

    def __post_init__(self):
        """Check the parameters; raise ValueError that states the rule and the value."""
        super().__post_init__()
        switch("rotations", self.rotations)

    def kernels(self) -> Kernels:
        """Kernels for the model's functions; see `Filter.kernels`."""
        plain = super().kernels()
        return with_rotation(plain) if self.rotations else plain


@dataclass(frozen=True, kw_only=True, eq=False)
class DeterministicEnsembleKalmanFilter(LocalisedFilter, DeterministicUpdateFilter):
    """Deterministic ensemble Kalman filter: the mean moves by the gain, the members' distances by half of it.

        predict: x_j = f(x_j, u) + w_j,  w_j ~ N(0, Q)
        update:  y_j = h(x_j),  innovation = z - mean(y),  S = cov(y, y) + R,  K = cov(x, y) S^-1,
                 mean += K innovation,  x_j - mean(x) -= K (y_j - mean(y))/2;  sample covariances, divisor N - 1

    With a linear h the update leaves P - K H P + K H P H'K'/4, more than the Kalman filter's P - K H P, by little
    where measurements are poor. The update draws nothing: only the process noise of the members is random, and the
    error of its sample mean and covariance enters the estimate.

    Attributes:
        radius: of Gaspari and Cohn's taper, in the unit of the model's `Positions`; 0 for no localisation. With
            one, entries of cov(x, y) and cov(y, y) are multiplied by the taper of the distance of both
            (P-localisation).

    The other attributes are those of `DeterministicUpdateFilter`.

    Raises:
        ValueError: if a parameter is out of its range, or there is a radius for a model without positions.

    Source: Sakov, Oke (2008), "A deterministic formulation of the ensemble Kalman filter".
    """

    name: ClassVar[str] = "denkf"
    page: ClassVar[Page] = Page(advance, settle, update)
