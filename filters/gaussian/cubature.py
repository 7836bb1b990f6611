"""The cubature Kalman filter: moments by the third-degree spherical-radial rule."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from filters.engine.belief import Kernels
from filters.filter import Filter
from filters.gaussian.sigma_points import PointSet, kernels_of


@dataclass(frozen=True, kw_only=True, eq=False)
class CubatureKalmanFilter(Filter):
    """Cubature Kalman filter with additive noise.

        points:  x_i = mean + sqrt(n) L_i,  x_{n+i} = mean - sqrt(n) L_i,  L L' = P,  each with the weight 1/(2n)
        moments: mean(y) = sum y_i/(2n),  cov(y) = sum d_i d_i'/(2n)  of values y_i = f(x_i), d_i = y_i - mean(y)
        predict: mean, P = mean(f(x, u)), cov(f(x, u)) + Q
        update:  points anew from the predicted mean and P,  innovation = z - mean(h(x)),  S = cov(h(x)) + R,
                 K = cov(x, h(x)) S^-1,  mean += K innovation,  and with e_i = h(x_i) - mean(h(x)),
                 P = sum (x_i - mean - K e_i)(x_i - mean - K e_i)'/(2n) + K R K'

    The last line equals P - K S K'; sums of squares, all covariances are symmetric and positive by construction.
    The rule is exact for cubic f and h. It has no numbers to choose: it gives the moments of an unscented filter
    with alpha = 1 and beta = kappa = 0, and does not ask for f and h at the mean itself.

    Source: Arasaratnam, Haykin (2009), "Cubature Kalman filters", IEEE Trans. Automatic Control 54(6), section IV.
    """

    name: ClassVar[str] = "ckf"

    @property
    def own_numbers(self) -> PointSet:
        """Where the points lie, and their weights."""
        n = self.model.n
        return PointSet(spread=n**0.5, weight=0.5 / n, shift_weight=0.0)

    def kernels(self) -> Kernels:
        """Kernels for the model's functions; see `Filter.kernels`."""
        return kernels_of(self.kernel_model, centre=False)
