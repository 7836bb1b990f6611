"""Sigma-point filters: unscented, its square-root form, and cubature; and the rules of a fuzzy filter."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from filters.algebra.matrices import operation
from filters.algebra.operations import divide, mask_missing, of_best_gain, present, sym, uncorrelated, wrap
from filters.algebra.points import first, log_density, on_circle, ones, outer, root, square, units, without_first
from filters.algebra.roots import hstack, part, triangle, vstack, zeros
from filters.algebra.tangents import after_reset, differences, move, points_around, reset
from filters.baselines import index_of
from filters.filter import PageFilter
from filters.gaussian.extended import initial_root, root_result
from filters.pages.page import Page
from thruster_env.core.checks import finite, one_of, positive, short_repr, vector
from thruster_env.graphs.graphs import where
from thruster_env.model.affine import AffineModel, linearize
from thruster_env.model.state_space import StateSpaceModel

MOST_STATES = 8  # premises, for 256 rules

# Sigma points of the scaled unscented transform, and moments of values at them.


def unscented_points(model, x, L):
    """The mean, and the points around it."""
    return points_around(model, x, (L * model.own.spread) @ units(first(L)))


def unscented_moments(model, Y, angles):
    """Mean of values at the points, its shift s from the central value, and deviations from the central value."""
    D = wrap(without_first(Y) - outer(first(Y), ones(without_first(Y))), angles)
    s = (D @ ones(D)) * model.own.weight
    return first(Y) + s, s, D


def unscented_state(model, X):
    """Mean and covariance of states at the points."""
    D = differences(model, without_first(X), first(X))
    s = (D @ ones(D)) * model.own.weight
    return move(model, first(X), s), reset(model, scatter(model, D, s), first(X), s)


def scatter(model, D, s):
    """The covariance of deviations D with the shift s."""
    return square(D) * model.own.weight + outer(s, s) * model.own.shift_weight


def propagate_points(model, X, u):
    """Propagate each point by one substep."""
    return model.f(X, u)


# The square-root form of the unscented filter: P, S and the gain follow from a triangle (`extended.root_result`).


def represent_unscented_root(model, x, P):
    """The points of a belief, from the root L in the extras."""
    return unscented_points(model, x, model.extras["L"])


def deviations(model, D, s):
    """A matrix A with A A' = scatter(D, s)."""
    return hstack(D * model.own.weight_root, outer(s * model.own.shift_root, ones(part(D, 0, 0, len(s), 1))))


def add_process_noise_unscented_root(model, X):
    """Mean and root of the points, with Q added, at the end of a step."""
    D = differences(model, without_first(X), first(X))
    s = (D @ ones(D)) * model.own.weight
    L = triangle(hstack(after_reset(model, deviations(model, D, s), first(X), s), model.Q_root))
    return move(model, first(X), s), square(L), {"L": L}


def update_unscented_root(model, x, P, z):
    """Update with the measurement z; NaN marks missing channels."""
    m, measured, L = len(z), present(z), model.extras["L"]
    y, s, D = unscented_moments(model, model.h(unscented_points(model, x, L)), model.measurement_angles)
    s, D, R = mask_missing(measured, s), mask_missing(measured, D), uncorrelated(measured, model.R)
    v = mask_missing(measured, wrap(z - y, model.measurement_angles))
    of_x = (L * model.own.spread) @ without_first(units(first(L))) * model.own.weight_root
    both = vstack(hstack(deviations(model, D, s), root(R)), hstack(of_x, zeros(L, len(L), m + 1)))
    return root_result(model, x, triangle(both), v, measured)


UNSCENTED_ROOT = Page(
    propagate_points,
    add_process_noise_unscented_root,
    update_unscented_root,
    represent_unscented_root,
    initial_root,
)


# The unscented Kalman filter: moments from the model's values at a few points, without Jacobians.


def represent_unscented(model, x, P):
    """The points of a belief."""
    return unscented_points(model, x, root(P))


def add_process_noise_unscented(model, X):
    """Mean and covariance of the points, with Q added, at the end of a step."""
    x, P = unscented_state(model, X)
    return x, P + model.Q


def update_unscented(model, x, P, z):
    """Update with the measurement z; NaN marks missing channels."""
    g, w = model.own.spread, model.own.weight
    L, measured = root(P), present(z)
    U = without_first(units(first(L)))
    y, s, D = unscented_moments(model, model.h(unscented_points(model, x, L)), model.measurement_angles)
    s, D, R = mask_missing(measured, s), mask_missing(measured, D), uncorrelated(measured, model.R)
    v = mask_missing(measured, wrap(z - y, model.measurement_angles))
    C = (L @ (U @ D.T)) * (w * g)
    S = scatter(model, D, s) + R
    K = divide(C, S)
    rest = scatter(model, (L * g) @ U - K @ D, K @ s) + sym(K @ R @ K.T)
    d, P = K @ v, of_best_gain(rest, P, C, S, K)
    return move(model, x, d), reset(model, P, x, d), v, S, log_density(v, S, measured)


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

    These are the moments with the usual weights, W_0 = 1 - n/g^2 for the mean, W_0 + 1 - alpha^2 + beta for the
    covariance and W_i = w. The central point is taken out of the sums, because its weight is negative for alpha
    below one. The last line, Joseph's form for points, equals P - K S K'. Every covariance is symmetric by
    construction, and positive because the filter requires alpha^2 kappa + beta n >= 0.

    Attributes:
        alpha: distance of the points from the mean, in units of sqrt(n + kappa) standard deviations. With 1 they
            reach the nonlinearity of f and h; with the common 0.001 the filter is nearly the extended one.
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
    takes_rotations: ClassVar[bool] = True
    page: ClassVar[Page] = Page(
        propagate_points, add_process_noise_unscented, update_unscented, represent_unscented
    )
    forms: ClassVar[Mapping[str, Page]] = {"square-root": UNSCENTED_ROOT}
    alpha: float = 1.0
    beta: float = 2.0
    kappa: float = 0.0
    form: str = "covariance"

    def __post_init__(self):
        n = self.model.t
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
        """The distance of the points, and their weights."""
        square, curvature = self.alpha**2 * (self.model.t + self.kappa), self.beta - self.alpha**2
        parameters = {"spread": square**0.5, "weight": 0.5 / square, "shift_weight": curvature}
        if self.form == "covariance":
            return parameters
        return parameters | {"weight_root": parameters["weight"] ** 0.5, "shift_root": curvature**0.5}


# The cubature Kalman filter: moments by the third-degree spherical-radial rule, with equal weights.


def represent_cubature(model, x, P):
    """The points of a belief; with rotations the mean comes before them."""
    return unscented_points(model, x, root(P)) if model.turns else cubature_points(model, x, root(P))


def cubature_points(model, x, L):
    """The points around the mean."""
    return points_around(model, x, (L * model.own.spread) @ without_first(units(first(L))))


def cubature_moments(model, Y, angles):
    """Mean of values at the points, and deviations from it, of angles on one branch around their mean."""
    Y = on_circle(Y, angles)
    y = (Y @ ones(Y)) * model.own.weight
    return y, Y - outer(y, ones(Y))


def add_process_noise_cubature(model, X):
    """Mean and covariance of the points, with Q added, at the end of a step."""
    x, D = cubature_state(model, X)
    return x, square(D) * model.own.weight + model.Q


def cubature_state(model, X):
    """Mean of states at the points, and deviations from it, in its tangent."""
    if not model.turns:
        x, D = cubature_moments(model, X, model.state_angles)
        return wrap(x, model.state_angles), D
    D = differences(model, without_first(X), first(X))
    s = (D @ ones(D)) * model.own.weight
    return move(model, first(X), s), after_reset(model, D - outer(s, ones(D)), first(X), s)


def update_cubature(model, x, P, z):
    """Update with the measurement z; NaN marks missing channels."""
    (g, w), L, measured = model.own, root(P), present(z)
    U = without_first(units(first(L)))
    y, D = cubature_moments(model, model.h(cubature_points(model, x, L)), model.measurement_angles)
    D, R = mask_missing(measured, D), uncorrelated(measured, model.R)
    v = mask_missing(measured, wrap(z - y, model.measurement_angles))
    C = (L @ (U @ D.T)) * (w * g)
    S = square(D) * w + R
    K = divide(C, S)
    rest = square((L * g) @ U - K @ D) * w + sym(K @ R @ K.T)
    d, P = K @ v, of_best_gain(rest, P, C, S, K)
    return move(model, x, d), reset(model, P, x, d), v, S, log_density(v, S, measured)


@dataclass(frozen=True, kw_only=True, eq=False)
class CubatureKalmanFilter(PageFilter):
    """Cubature Kalman filter with additive noise.

        points:  X = x 1' + g L U,  L L' = P,  U = [I, -I],  g = sqrt(n): x + sqrt(n) L_i and x - sqrt(n) L_i
        moments: of values Y, with w = 1/(2n):  mean y = w Y 1,  D = Y - y 1',  cov w D D'
        predict: x, P = mean(f(X, u)), cov(f(X, u)) + Q
        update:  points again, from the predicted x and P;  v = z - mean(h(X)),  S = cov(h(X)) + R,
                 K = w g L U D' S^-1,  x += K v,  P = w (g L U - K D) (g L U - K D)' + K R K'

    The last line equals P - K S K'; sums of squares, all covariances are symmetric and positive by construction.
    The moments are exact for cubic f and h. The filter has no parameters: its moments are those of an unscented
    filter with alpha = 1 and beta = kappa = 0, but it does not evaluate f and h at the mean, only f if a state has
    rotations, whose deviations begin there.

    Source: Arasaratnam, Haykin (2009), "Cubature Kalman filters", IEEE Trans. Automatic Control 54(6), section IV.
    """

    name: ClassVar[str] = "ckf"
    takes_rotations: ClassVar[bool] = True
    page: ClassVar[Page] = Page(propagate_points, add_process_noise_cubature, update_cubature, represent_cubature)

    @property
    def parameters(self) -> dict[str, float]:
        """The distance of the points, and their weight."""
        n = self.model.t
        return {"spread": n**0.5, "weight": 0.5 / n}


# Rules of a fuzzy filter: a model's affine approximations at the corners of a range of its states.


@operation(lambda x, low, high, premises: (2 ** len(premises),))
def memberships(x, low, high, premises):
    """Memberships of a state x in all rules: products over the premises of its degree of low or high, by bits."""
    w = np.ones(1)
    for i in premises:
        part = (x[i] - low[i]) / (high[i] - low[i])
        of_high = where(part < 0.0, 0.0, where(part > 1.0, 1.0, part))
        w = np.concatenate([w * (1.0 - of_high), w * of_high])
    return w


def rules_at_corners(
    model: StateSpaceModel, low: np.ndarray, high: np.ndarray, premises: tuple[int, ...], offsets: bool
) -> tuple[AffineModel, ...]:
    """The affine model of each rule, linearised at low or high in each premise, as the rule's bits say."""
    control = np.zeros(model.inputs) if model.operating_input is None else model.operating_input
    rules, before = [], model.n * (model.n + model.inputs)
    for rule in range(2 ** len(premises)):
        corner = (low + high) / 2
        for bit, i in enumerate(premises):
            corner[i] = (high if rule >> bit & 1 else low)[i]
        affine = linearize(model, corner, control)
        c = affine.constants  # A, B, the offset of the state, C and that of the measurement
        without = c[:before] + (0.0,) * model.n + c[before + model.n :]
        rules.append(affine if offsets else affine.replace(constants=without))
    return tuple(rules)


def checked_corners(model: StateSpaceModel, low: Any, high: Any, premises: Any) -> dict[str, Any]:
    """The range of the states, and the indices of the rules' premises; ValueError if the range is unknown."""
    indices = _checked_premises(model, premises)
    low, high = model.state_low if low is None else low, model.state_high if high is None else high
    if isinstance(model, AffineModel):  # its rules are all alike, whatever the range
        low = model.prior_mean - model.scales if low is None else low
        high = model.prior_mean + model.scales if high is None else high
    if low is None or high is None:
        rule = "a fuzzy filter must know the range of the states"
        raise ValueError(f"{rule}, but got neither low and high nor a model with state_low and state_high")
    low, high = vector("low", low, model.n), vector("high", high, model.n)
    if not (low < high).all():
        raise ValueError(
            f"low must be below high in every state, but got {short_repr(low)} and {short_repr(high)}"
        )
    return {"premises": indices, "low": low, "high": high}


def _checked_premises(model: StateSpaceModel, premises: Any) -> tuple[int, ...]:
    """Indices of the states that are premises of rules; if None, all, or the first one of a large affine model."""
    n, premises_text = model.n, f"all {model.n} states" if premises is None else short_repr(premises)
    if premises is None:
        premises = (0,) if n > MOST_STATES and isinstance(model, AffineModel) else range(n)  # all rules are alike
    try:
        indices = tuple(index_of("premises", index, n) for index in premises)
    except TypeError:
        indices = ()
    if not 1 <= len(indices) <= MOST_STATES or len(set(indices)) < len(indices):
        rule = f"premises must name 1 to {MOST_STATES} different states, for there is a rule for each corner"
        raise ValueError(f"{rule} of their range, but got {premises_text}")
    return indices
