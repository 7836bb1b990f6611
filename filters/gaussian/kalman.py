"""The Kalman filter: affine models, schedules of operating points, the information form, and the steady gain."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from filters.algebra.operations import divide, joseph, mask_missing, present, sym, uncorrelated, wrap
from filters.algebra.points import hats, log_density
from filters.algebra.roots import inverse_of, zeros
from filters.filter import PageFilter
from filters.gaussian import extended
from filters.gaussian.extended import ExtendedKalmanFilter, add_process_noise, propagate
from filters.pages.page import Page
from thruster_env.core.checks import at_least, covariance, one_of, short_repr
from thruster_env.model.affine import AffineModel, linearize

MOST_POINTS = 200  # of a schedule; programs are written out for them
STABLE = 1.0 - 1e-7  # upper limit of |eigenvalues| of A (I - K C): errors decay within ten million steps


def update_information(model, x, P, z):
    """Update with the measurement z, by the inverse of the covariance; NaN marks missing channels.

        Y = P^-1 + H' R^-1 H,  P = Y^-1,  x += P H' R^-1 v

    Every channel adds its own information H' R^-1 H, so many channels and few states are cheap. The update needs
    no gain and no inverse of S, which is only computed for the likelihood. P must be positive definite throughout.
    Inverses are products W' W of inverse Cholesky factors W, symmetric and positive by construction.

    Source: Anderson, Moore (1979), Optimal Filtering, section 6.3.
    """
    measured = present(z)
    H, R = mask_missing(measured, model.H(x)), uncorrelated(measured, model.R)
    v = mask_missing(measured, wrap(z - model.h(x), model.measurement_angles))
    S = sym(H @ P @ H.T + R)
    W = divide(H.T, R)  # H' R^-1
    P = inverse_of(sym(inverse_of(P) + W @ H))
    return wrap(x + P @ (W @ v), model.state_angles), P, v, S, log_density(v, S, measured)


INFORMATION = Page(propagate, add_process_noise, update_information)


def constants_at(model, u):
    """Constants of the affine model at an input."""
    return model.own.models.T @ hats(u, model.own.inputs)


def initial_scheduled(model):
    """The constants at u = 0, as an extra."""
    return {"c": constants_at(model, zeros(model.own.models, 1))}


def propagate_scheduled(model, x, P, u):
    """Propagate by one substep of the affine model at u."""
    c = constants_at(model, u)
    return *extended.propagate(model.at(c), x, P, u), {"c": c}


def update_scheduled(model, x, P, z):
    """Update with the measurement z by the affine model of the last substep."""
    return extended.update(model.at(model.extras["c"]), x, P, z)


SCHEDULED = Page(propagate_scheduled, extended.add_process_noise, update_scheduled, initial=initial_scheduled)


@dataclass(frozen=True, kw_only=True, eq=False)
class AffineFilter(PageFilter):
    """Base of filters that run on an affine model, or on the affine approximation of a model about one point."""

    any_step: ClassVar[bool] = False  # A and B are those of one sample time

    def __post_init__(self):
        point = self.model.operating_state, self.model.operating_input
        if any(part is None for part in point) and not isinstance(self.model, AffineModel):
            raise ValueError(
                "a Kalman filter must have an affine model (filters.affine_model makes one), or one with an "
                "operating state and input (operating_state=..., operating_input=...), but got "
                f"operating_state={point[0]!r}, operating_input={point[1]!r}"
            )

    @cached_property
    def kernel_model(self) -> AffineModel:
        """The affine model that the filter runs on, of one sample time."""
        return linearize(self.model, self.model.operating_state, self.model.operating_input)


@dataclass(frozen=True, kw_only=True, eq=False)
class KalmanFilter(AffineFilter):
    """Kalman filter of an affine model, or of affine approximations of a model about operating points.

        predict: mean = A mean + B u + a,  P = A P A' + Q
        update:  innovation = z - C mean - d,  S = C P C' + R,  K = P C' S^-1,
                 mean += K innovation,  P = (I - K C) P (I - K C)' + K R K'  (Joseph)

    On an affine model the extended filter computes exactly this, so it is used.

    By default the operating point is the model's `operating_state` and `operating_input`; offsets are kept. With a
    `schedule` of several points A, B, a, C, d depend on the input: they are linear in u between the model's
    `operating_points` and constant beyond them; at the first measurement they are those of u = 0.

    Attributes:
        form: form of the recursion: "covariance" as above, "information" (`update_information`), "square-root" or
            "ud" (`gaussian.extended`). The estimates are equal to rounding.
        schedule: number of operating points, spread over the range of the input; 1 for the model's own point.

    Raises:
        ValueError: if a nonlinear model has no operating point, the form is unknown, the information form meets a
            singular prior covariance, or a schedule meets another form or a model without operating points.

    Source: Kalman (1960), "A new approach to linear filtering and prediction problems"; for schedules Rugh,
    Shamma (2000), "Research on gain scheduling", Automatica 36(10).
    """

    name: ClassVar[str] = "kf"
    by_length: ClassVar[bool] = True
    page: ClassVar[Page] = ExtendedKalmanFilter.page
    forms: ClassVar[Mapping[str, Page]] = {"information": INFORMATION, **ExtendedKalmanFilter.forms}
    form: str = "covariance"
    schedule: int = 1

    def __post_init__(self):
        super().__post_init__()
        one_of("form", self.form, self.known_forms)
        object.__setattr__(self, "schedule", at_least("schedule", self.schedule, 1, MOST_POINTS))
        if self.form == "information":
            covariance("prior_cov", self.model.prior_cov, self.model.n, positive_definite=True)
        if self.schedule > 1 and (self.model.operating_points is None or self.form != "covariance"):
            raise ValueError(
                "a schedule must come with the covariance form and a model that has operating points, "
                f"but got schedule={self.schedule}, form={self.form!r}, "
                f"operating_points={short_repr(self.model.operating_points)}"
            )
        _ = self.own_parameters  # raises ValueError for an operating point that does not exist

    @cached_property
    def parameters(self) -> dict[str, np.ndarray]:
        """The inputs of a schedule, and the constants of the affine model at each."""
        operating_points = self.model.operating_points
        if self.schedule == 1 or operating_points is None:
            return {}
        points = operating_points(self.schedule)
        inputs = [float(u) for _, (u,) in points]
        if not (np.diff(inputs) > 0).all():
            raise ValueError(f"the inputs of operating points must increase, but got {inputs}")
        models = [linearize(self.model, state, control) for state, control in points]
        return {"inputs": np.array(inputs), "models": np.array([model.constants for model in models])}

    @property
    def follows_from(self) -> Mapping[str, tuple[str, ...]]:
        """The models of a schedule, from the model's constants."""
        return {"models": ("constants",)} if self.parameters else {}

    @property
    def written_page(self) -> Page:
        """The page of the form, or of a schedule."""
        page = super().written_page
        return SCHEDULED._replace(own=page.own) if self.schedule > 1 else page


def update_steady(model, x, P, z):
    """Update with the measurement z; missing channels (NaN) have no innovation and no column of the gain."""
    measured = present(z)
    H, R, K = (
        mask_missing(measured, model.H(x)),
        uncorrelated(measured, model.R),
        mask_missing(measured, model.own.gain.T).T,
    )
    v = mask_missing(measured, wrap(z - model.h(x), model.measurement_angles))
    S = sym(H @ P @ H.T + R)
    return wrap(x + K @ v, model.state_angles), joseph(P, K, H, R), v, S, log_density(v, S, measured)


@dataclass(frozen=True, kw_only=True, eq=False)
class SteadyStateKalmanFilter(AffineFilter):
    """Kalman filter with a constant gain: the limit of the Kalman gain.

        K = P C' (C P C' + R)^-1,  P = A P A' - K C P A' + Q  (Riccati's equation for the predicted covariance)
        predict: mean = A mean + B u + a
        update:  mean += K (z - C mean - d), in missing channels without their columns of K

    Like "kf" it runs on an affine model, or on the affine approximation of a model about its operating point. It
    equals "kf" if that starts from the solution P as its prior covariance.

    The covariance of a belief is that of the errors with this gain, from the prior on: A P A' + Q in predictions,
    and (I - K C) P (I - K C)' + K R K' (Joseph's form, valid for any gain) in updates. It converges to the
    solution of Riccati's equation, stays consistent when measurements are missing, and does not influence the
    estimate. The gain holds for one Q and R: the filter refuses Q or R of a single step.

    Attributes:
        gain: K, (n, m).

    Raises:
        ValueError: if a nonlinear model has no operating point, or Riccati's equation has no stabilising solution:
            unstable and marginally stable modes must be observable, and marginally stable ones driven by Q.

    Source: Anderson, Moore (1979), Optimal Filtering, section 4.4.
    """

    name: ClassVar[str] = "kf-steady"
    page: ClassVar[Page] = Page(propagate, add_process_noise, update_steady)
    varying_noise: ClassVar[bool] = False

    def __post_init__(self):
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
        from filters.bounds import steady_state  # here, because that module imports filters

        model = self.kernel_model
        a, _, _, c, _ = model.matrices()
        return steady_state(a, c, model.process_noise_cov, model.measurement_noise_cov)[1]

    @property
    def parameters(self) -> dict[str, np.ndarray]:
        """The gain."""
        return {"gain": self.gain}

    @property
    def follows_from(self) -> Mapping[str, tuple[str, ...]]:
        """The gain follows from all numbers of the model except the prior."""
        return {"gain": ("process_noise_cov", "measurement_noise_cov", "constants")}
