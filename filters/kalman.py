"""The Kalman filter, for affine models and for affine approximations of others."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

from filters.affine import AffineModel, linearize
from filters.belief import Kernels
from filters.extended import kernels_of
from filters.filter import Filter


@dataclass(frozen=True, kw_only=True, eq=False)
class KalmanFilter(Filter):
    """Kalman filter of an affine model, or of the affine approximation of a model about one operating point.

        predict: mean = A mean + B u + a,  P = A P A' + Q
        update:  innovation = z - C mean - d,  S = C P C' + R,  K = P C' S^-1,
                 mean += K innovation,  P = (I - K C) P (I - K C)' + K R K'  (Joseph)

    On an affine model the extended filter does exactly this, so it does the work.

    The operating point is the model's `operating_state` and `operating_input`; offsets are kept.

    Source: Kalman (1960), "A new approach to linear filtering and prediction problems".
    """

    name: ClassVar[str] = "kf"

    def __post_init__(self):
        """Raise ValueError if a nonlinear model comes without an operating point."""
        point = self.model.operating_state, self.model.operating_input
        if any(part is None for part in point) and not isinstance(self.model, AffineModel):
            raise ValueError(
                "a Kalman filter must have an affine model, or one with an operating state and input, but got "
                f"operating_state={point[0]!r}, operating_input={point[1]!r}"
            )

    @cached_property
    def kernel_model(self) -> AffineModel:
        """The affine model that the filter runs on."""
        return linearize(self.model, self.model.operating_state, self.model.operating_input)

    def kernels(self) -> Kernels:
        """Kernels of the extended filter on the affine model."""
        return kernels_of(self.kernel_model)
