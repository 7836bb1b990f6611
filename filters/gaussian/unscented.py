"""The unscented Kalman filter: moments from the model's values at a few points, without derivatives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from filters.engine.belief import Kernels
from filters.filter import Filter
from filters.gaussian.sigma_points import PointSet, kernels_of
from numerics.checks import finite, positive


@dataclass(frozen=True, kw_only=True, eq=False)
class UnscentedKalmanFilter(Filter):
    """Unscented Kalman filter with the scaled transform and additive noise.

        points:  x_0 = mean,  x_i = mean + g L_i,  x_{n+i} = mean - g L_i,  L L' = P,  g = alpha sqrt(n + kappa)
        moments: of values y_i = f(x_i), with d_i = y_i - y_0, w = 1/(2 g^2) and i = 1 ... 2n,
                 s = w sum d_i,  mean(y) = y_0 + s,  cov(y) = w sum d_i d_i' + (beta - alpha^2) s s'
        predict: mean, P = mean(f(x, u)), cov(f(x, u)) + Q
        update:  points anew from the predicted mean and P,  innovation = z - mean(h(x)),  S = cov(h(x)) + R,
                 K = cov(x, h(x)) S^-1,  mean += K innovation,  and with e_i = h(x_i) - h(x_0), s = w sum e_i,
                 P = w sum (x_i - x_0 - K e_i)(x_i - x_0 - K e_i)' + (beta - alpha^2) K s (K s)' + K R K'

    These are the moments of the usual weights, W_0 = 1 - n/g^2 for the mean, W_0 + 1 - alpha^2 + beta for the
    covariance and W_i = w, with the point in the centre taken out of the sums: a negative weight, which alpha
    below one gives the centre, is then in none of them. The last line equals P - K S K' and is for points what
    Joseph's form is for matrices. Every covariance is symmetric by construction, and positive as long as
    alpha^2 kappa + beta n is not negative, which is checked.

    Attributes:
        alpha: distance of the points; 1 puts them sqrt(n + kappa) standard deviations from the mean, where the
            nonlinearity of f and h shows. With the common 0.001 the filter is hardly more than an extended one.
        beta: prior knowledge of the distribution beyond its moments; 2 is best for Gaussian ones.
        kappa: moves the points further out and gives the centre a larger weight; above -n.

    Raises:
        ValueError: if alpha or n + kappa is not positive, or alpha^2 kappa + beta n is negative.

    Source: Julier (2002), "The scaled unscented transformation"; Wan, van der Merwe (2000), "The unscented Kalman
    filter for nonlinear estimation".
    """

    name: ClassVar[str] = "ukf"
    alpha: float = 1.0
    beta: float = 2.0
    kappa: float = 0.0

    def __post_init__(self):
        """Check the parameters; raise ValueError that states the rule and the value."""
        n = self.model.n
        alpha, beta, kappa = positive("alpha", self.alpha), finite("beta", self.beta), finite("kappa", self.kappa)
        if n + kappa <= 0:
            raise ValueError(f"kappa must be above minus the number of states, {-n}, but got {kappa}")
        if alpha**2 * kappa + beta * n < 0:
            raise ValueError(
                "alpha^2 kappa + beta n must not be negative, or covariances could be, "
                f"but got alpha={alpha}, beta={beta}, kappa={kappa} for n = {n} states"
            )
        for name, value in (("alpha", alpha), ("beta", beta), ("kappa", kappa)):
            object.__setattr__(self, name, value)

    @property
    def own_numbers(self) -> PointSet:
        """Where the points lie, and their weights."""
        square = self.alpha**2 * (self.model.n + self.kappa)
        return PointSet(spread=square**0.5, weight=0.5 / square, shift_weight=self.beta - self.alpha**2)

    def kernels(self) -> Kernels:
        """Kernels for the model's functions; see `Filter.kernels`."""
        return kernels_of(self.kernel_model, centre=True)
