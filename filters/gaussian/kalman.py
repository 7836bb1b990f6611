"""The Kalman filter, for affine models and for affine approximations of others."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from filters.gaussian.extended import ExtendedKalmanFilter
from filters.gaussian.information import INFORMATION
from filters.gaussian.schedule import SCHEDULED
from filters.pages.page_filter import Page, PageFilter
from thruster_env.core.checks import at_least, covariance, one_of
from thruster_env.model.affine import AffineModel, linearize

MOST_POINTS = 200  # of a schedule; programs are written out for them


@dataclass(frozen=True, kw_only=True, eq=False)
class AffineFilter(PageFilter):
    """Base of filters that run on an affine model, or on the affine approximation of a model about one point."""

    any_step: ClassVar[bool] = False  # A and B of a model are those of one sample time

    def __post_init__(self):
        """Raise ValueError if a nonlinear model comes without an operating point."""
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
        form: form of the recursion: "covariance" as above, "information" (`gaussian.information`), "square-root"
            (`gaussian.square_root`) or "ud" (`gaussian.ud`). The estimates are equal to rounding.
        schedule: number of operating points, spread over the range of the input; 1 for the model's own point.

    Raises:
        ValueError: if a nonlinear model has no operating point, the form is unknown, the information form meets a
            singular prior covariance, or a schedule meets another form or a model without operating points.

    Source: Kalman (1960), "A new approach to linear filtering and prediction problems"; for schedules Rugh,
    Shamma (2000), "Research on gain scheduling", Automatica 36(10).
    """

    name: ClassVar[str] = "kf"
    page: ClassVar[Page] = ExtendedKalmanFilter.page
    forms: ClassVar[Mapping[str, Page]] = {"information": INFORMATION, **ExtendedKalmanFilter.forms}
    form: str = "covariance"
    schedule: int = 1

    def __post_init__(self):
        """Check the model, the form and the schedule."""
        super().__post_init__()
        one_of("form", self.form, self.known_forms)
        object.__setattr__(self, "schedule", at_least("schedule", self.schedule, 1, MOST_POINTS))
        if self.form == "information":
            covariance("prior_cov", self.model.prior_cov, self.model.n, positive_definite=True)
        if self.schedule > 1 and (self.model.operating_points is None or self.form != "covariance"):
            raise ValueError(
                "a schedule must come with the covariance form and a model that has operating points, "
                f"but got schedule={self.schedule}, form={self.form!r}, "
                f"operating_points={self.model.operating_points!r}"
            )
        _ = self.own_parameters  # an operating point that does not exist shows here

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
