"""The Kalman filter, for affine models and for affine approximations of others."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

from filters.affine import AffineModel, linearize
from filters.extended import kernels_of
from filters.filter import Filter, Kernels


@dataclass(frozen=True, kw_only=True, eq=False)
class KalmanFilter(Filter):
    """Kalman filter of an affine model, or of the affine approximation of a model about one operating point.

        predict: mean = A mean + B u + a,  P = A P A' + Q
        update:  innovation = z - C mean - d,  S = C P C' + R,  K = P C' S^-1,
                 mean += K innovation,  P = (I - K C) P (I - K C)' + K R K'  (Joseph)

    On an affine model the extended filter does exactly this, so it does the work.

    Attributes:
        operating_state: x* (n,) about which a nonlinear model is approximated; not needed for affine ones.
        operating_input: u* (p,).

    Source: Kalman (1960), "A new approach to linear filtering and prediction problems".
    """

    name: ClassVar[str] = "kf"
    operating_state: Any = None
    operating_input: Any = None

    def __post_init__(self):
        """Raise ValueError if a nonlinear model comes without an operating point."""
        given = self.operating_state is not None and self.operating_input is not None
        if not given and not isinstance(self.model, AffineModel):
            raise ValueError(
                "a Kalman filter must have an affine model or an operating state and input to approximate "
                f"one, but got operating_state={self.operating_state!r}, operating_input="
                f"{self.operating_input!r}"
            )

    @cached_property
    def kernel_model(self) -> AffineModel:
        """The affine model that the filter runs on."""
        return linearize(self.model, self.operating_state, self.operating_input)

    def kernels(self) -> Kernels:
        """Kernels of the extended filter on the affine model."""
        return kernels_of(self.kernel_model)
