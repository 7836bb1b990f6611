"""The steady-state Kalman filter: one gain for all steps, from Riccati's equation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from filters.algebra.densities import log_density
from filters.algebra.operations import joseph, only, present, sym, uncorrelated, wrap
from filters.gaussian.extended import advance, settle
from filters.gaussian.kalman import AffineFilter
from filters.pages.page import Page

STABLE = 1.0 - 1e-7  # magnitude of an eigenvalue of A (I - K C): an error lasts for less than ten million steps


def update(model, x, P, z):
    """The measurement z; channels that are NaN are missing, and so are their columns of the gain."""
    seen = present(z)
    H, R, K = only(seen, model.H(x)), uncorrelated(seen, model.R), only(seen, model.own.gain.T).T
    v = only(seen, wrap(z - model.h(x), model.measurement_angles))
    S = sym(H @ P @ H.T + R)
    return wrap(x + K @ v, model.state_angles), joseph(P, K, H, R), v, S, log_density(v, S, seen)


@dataclass(frozen=True, kw_only=True, eq=False)
class SteadyStateKalmanFilter(AffineFilter):
    """Kalman filter with a constant gain: the limit of the Kalman gain.

        K = P C' (C P C' + R)^-1,  P = A P A' - K C P A' + Q  (Riccati's equation for the predicted covariance)
        predict: mean = A mean + B u + a
        update:  mean += K (z - C mean - d), in missing channels without their columns of K

    Like "kf" it runs on an affine model, or on the affine approximation of a model about its operating point. It
    equals "kf" where that starts from the solution P as its prior covariance.

    The covariance of a belief is that of the errors which this gain leaves: from the prior on A P A' + Q and
    (I - K C) P (I - K C)' + K R K' (Joseph's form), which holds for any gain. It tends to the solution of
    Riccati's equation, stays consistent where measurements are missing, and has no influence on the estimate. The
    gain belongs to one Q and R: a Q or R of a single step is refused.

    Attributes:
        gain: K, (n, m).

    Raises:
        ValueError: if a nonlinear model has no operating point, or Riccati's equation has no stabilising solution:
            unstable and marginally stable modes must be observable, and marginally stable ones driven by Q.

    Source: Anderson, Moore (1979), Optimal Filtering, section 4.4.
    """

    name: ClassVar[str] = "kf-steady"
    page: ClassVar[Page] = Page(advance, settle, update)
    varying_noise: ClassVar[bool] = False

    def __post_init__(self):
        """Check the model, and solve for the gain."""
        super().__post_init__()
        a, _, _, c, _ = self.kernel_model.matrices()
        try:
            fastest = np.abs(np.linalg.eigvals(a - a @ self.gain @ c)).max()
        except (np.linalg.LinAlgError, ValueError):  # no solution, or one that is not finite
            fastest = np.inf
        if not fastest < STABLE:
            raise ValueError(
                "a steady-state filter must have a model for which Riccati's equation has a stabilising solution, "
                f"but got A = {a.tolist()}"
            )

    @cached_property
    def gain(self) -> np.ndarray:
        """The gain K (n, m)."""
        from filters.bounds import steady_state  # which runs filters of this package

        model = self.kernel_model
        a, _, _, c, _ = model.matrices()
        return steady_state(a, c, model.process_noise_cov, model.measurement_noise_cov)[1]

    @property
    def parameters(self) -> dict[str, np.ndarray]:
        """The gain."""
        return {"gain": self.gain}

    @property
    def follows_from(self) -> Mapping[str, tuple[str, ...]]:
        """The gain, from all but the prior."""
        return {"gain": ("process_noise_cov", "measurement_noise_cov", "constants")}
