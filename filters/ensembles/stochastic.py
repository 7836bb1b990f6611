"""The stochastic ensemble Kalman filter: each member is drawn to a measurement with noise of its own."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from filters.algebra.members import centred
from filters.algebra.operations import divide
from filters.ensembles.localised import LocalisedFilter
from filters.ensembles.steps import advance, compare, settle
from filters.pages.page_filter import Page
from thruster_env.core.checks import switch


def update(model, x, z, e):
    """The measurement z; channels that are NaN are missing."""
    d, C, v, S, _, level = compare(model, x, z)
    e = centred(e) if model.own.centred_perturbations else e
    return x + divide(C, S) @ (v - d - model.R_root @ e), v, S, level


@dataclass(frozen=True, kw_only=True, eq=False)
class EnsembleKalmanFilter(LocalisedFilter):
    """Stochastic ensemble Kalman filter, on the full nonlinear model, with perturbed measurements.

        predict: x_j = f(x_j, u) + w_j,  w_j ~ N(0, Q)
        update:  y_j = h(x_j),  innovation = z - mean(y),  S = cov(y, y) + R,  K = cov(x, y) S^-1,
                 x_j += K (z - v_j - y_j),  v_j ~ N(0, R);  sample covariances with divisor N - 1

    The perturbations of an update depend on the key and the step only: two updates within one step use the same
    perturbations.

    Attributes:
        centred_perturbations: 1 for perturbations of the measurements whose sample mean is zero, 0 for independent
            ones. Centred, v_j is (N/(N - 1))^1/2 (v_j - mean(v)), whose covariance is R, and the mean moves as
            in the Kalman filter; the mean of independent ones, of covariance R/N, enters the estimate. Use it for
            small N.

        radius: of Gaspari and Cohn's taper, in the unit of the model's `Positions`; 0 for no localisation. With
            one, entries of cov(x, y) and cov(y, y) are multiplied by the taper of the distance of both
            (P-localisation).

    The other attributes are those of `EnsembleFilter`.

    Raises:
        ValueError: if a parameter is out of its range, or there is a radius for a model without positions.

    Source: Evensen (1994); Burgers, van Leeuwen, Evensen (1998), "Analysis scheme in the EnKF"; centred: Evensen
    (2004), "Sampling strategies and square root analysis schemes for the EnKF"; with tapers: Houtekamer, Mitchell
    (2001), "A sequential ensemble Kalman filter for atmospheric data assimilation".
    """

    name: ClassVar[str] = "enkf"
    page: ClassVar[Page] = Page(advance, settle, update)
    unrolled: ClassVar[tuple[str, ...]] = ("centred_perturbations",)
    centred_perturbations: int = 0

    def __post_init__(self):
        """Check the parameters; raise ValueError that states the rule and the value."""
        super().__post_init__()
        switch("centred_perturbations", self.centred_perturbations)
