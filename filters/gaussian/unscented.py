"""The unscented Kalman filter: moments from the model's values at a few points, without Jacobians."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from filters.algebra.densities import log_density
from filters.algebra.operations import divide, of_best_gain, only, present, sym, uncorrelated, wrap
from filters.algebra.points import others, root, units
from filters.gaussian.unscented_points import advance, moments, points, scatter
from filters.gaussian.unscented_root import ROOT
from filters.pages.page_filter import Page, PageFilter
from thruster_env.core.checks import finite, one_of, positive


def begin(model, x, P):
    """The points of a belief."""
    return points(model, x, root(P))


def settle(model, X):
    """The end of a step."""
    x, s, D = moments(model, X, model.state_angles)
    return wrap(x, model.state_angles), scatter(model, D, s) + model.Q


def update(model, x, P, z):
    """The measurement z; channels that are NaN are missing."""
    g, w = model.own.spread, model.own.weight
    L, U, seen = root(P), others(units(x)), present(z)
    y, s, D = moments(model, model.h(points(model, x, L)), model.measurement_angles)
    s, D, R = only(seen, s), only(seen, D), uncorrelated(seen, model.R)
    v = only(seen, wrap(z - y, model.measurement_angles))
    C = (L @ (U @ D.T)) * (w * g)
    S = scatter(model, D, s) + R
    K = divide(C, S)
    rest = scatter(model, (L * g) @ U - K @ D, K @ s) + sym(K @ R @ K.T)
    return wrap(x + K @ v, model.state_angles), of_best_gain(rest, P, C, S, K), v, S, log_density(v, S, seen)


@dataclass(frozen=True, kw_only=True, eq=False)
class UnscentedKalmanFilter(PageFilter):
    """Unscented Kalman filter with the scaled transform and additive noise.

        points:  X = x 1' + g L U,  L L' = P,  U = [0, I, -I],  g = alpha sqrt(n + kappa)
        moments: of values Y, with D = [y_i - y_0], i = 1 ... 2n, w = 1/(2 g^2) and b = beta - alpha^2:
                 s = w D 1,  mean y_0 + s,  cov w D D' + b s s'
        predict: x, P = mean(f(X, u)), cov(f(X, u)) + Q
        update:  points again, from the predicted x and P;  v = z - mean(h(X)),  S = cov(h(X)) + R,
                 K = w g L U h(X)' S^-1,  x += K v,
                 P = w (g L U - K D) (g L U - K D)' + b K s (K s)' + K R K'

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
        form: "covariance" as above, or "square-root", which carries L and keeps twice the digits of P; beta must
            then be at least alpha^2. The estimates are equal to rounding.

    Raises:
        ValueError: if alpha or n + kappa is not positive, alpha^2 kappa + beta n is negative, or the
            form is unknown or does not go with beta.

    Source: Julier (2002), "The scaled unscented transformation"; Wan, van der Merwe (2000), "The unscented Kalman
    filter for nonlinear estimation"; for the square-root form van der Merwe, Wan (2001), "The square-root
    unscented Kalman filter for state and parameter-estimation".
    """

    name: ClassVar[str] = "ukf"
    page: ClassVar[Page] = Page(advance, settle, update, begin)
    forms: ClassVar[Mapping[str, Page]] = {"square-root": ROOT}
    alpha: float = 1.0
    beta: float = 2.0
    kappa: float = 0.0
    form: str = "covariance"

    def __post_init__(self):
        """Check the parameters; raise ValueError that states the rule and the value."""
        n = self.model.n
        alpha, beta, kappa = positive("alpha", self.alpha), finite("beta", self.beta), finite("kappa", self.kappa)
        if n + kappa <= 0:
            raise ValueError(f"kappa must be above minus the number of states, {-n}, but got {kappa}")
        if alpha**2 * kappa + beta * n < 0:
            rule = "alpha^2 kappa + beta n must not be negative, or covariances could be"
            raise ValueError(f"{rule}, but got alpha={alpha}, beta={beta}, kappa={kappa} for n = {n} states")
        if one_of("form", self.form, self.known_forms) == "square-root" and beta < alpha**2:
            rule = "beta of the square-root form must be at least alpha^2"
            raise ValueError(f"{rule}, {alpha**2:g}, but got {beta}")
        for name, value in (("alpha", alpha), ("beta", beta), ("kappa", kappa)):
            object.__setattr__(self, name, value)

    @property
    def parameters(self) -> dict[str, float]:
        """Where the points lie, and their weights."""
        square, curvature = self.alpha**2 * (self.model.n + self.kappa), self.beta - self.alpha**2
        found = {"spread": square**0.5, "weight": 0.5 / square, "shift_weight": curvature}
        if self.form == "covariance":
            return found
        return found | {"weight_root": found["weight"] ** 0.5, "shift_root": curvature**0.5}
