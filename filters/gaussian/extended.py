"""The extended Kalman filter and its kin: iterated, with a fading memory, Schmidt's, and the H-infinity filter.

All linearise the model along their own estimate. The square-root and the UD form keep twice the digits of P.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from filters.algebra import roots
from filters.algebra.operations import divide, eye, joseph, mask_missing, present, sym, uncorrelated, wrap
from filters.algebra.points import density, log_density, root, square
from filters.algebra.roots import factor_of, forward_quotient, hstack, part, triangle, vstack, zeros
from filters.algebra.tangents import after_reset, move, reset, reset_columns
from filters.baselines import indices_of
from filters.filter import PageFilter
from filters.pages.page import Page
from thruster_env.core.checks import at_least, between, one_of, positive, vector

MOST_ITERATIONS = 20

# The extended Kalman filter: the Kalman filter of the model linearised along its own estimate.


def propagate(model, x, P, u):
    """Propagate mean and covariance by one substep."""
    F = model.F(x, u)
    return wrap(model.f(x, u), model.state_angles), sym(F @ P @ F.T)


def add_process_noise(model, x, P):
    """Add Q at the end of a step."""
    return x, sym(P + model.Q)


def update(model, x, P, z):
    """Update with the measurement z; NaN marks missing channels."""
    measured = present(z)
    H, R = mask_missing(measured, model.H(x)), uncorrelated(measured, model.R)
    v = mask_missing(measured, wrap(z - model.h(x), model.measurement_angles))
    S = sym(H @ P @ H.T + R)
    K = divide(P @ H.T, S)
    d = K @ v
    return move(model, x, d), reset(model, joseph(P, K, H, R), x, d), v, S, log_density(v, S, measured)


# The square-root form of the Kalman filter carries the root L of P = L L', by orthogonal Theta from the right that
# make a matrix lower triangular:
#
#     predict: [F L, Q^(1/2)] Theta = [L, 0]
#     update:  [[R^(1/2), H L], [0, L]] Theta = [[S^(1/2), 0], [K S^(1/2), L]],  x += (K S^(1/2)) S^(-1/2) v
#
# P = L L' is for the reader only: no covariance is formed from another, so L keeps twice the digits of states that
# are known a million times better than others. Source: Kaminski, Bryson, Schmidt (1971), "Discrete square root
# filtering: a survey of current techniques", IEEE Trans. Automatic Control 16(6).


def initial_root(model):
    """The root of the prior covariance."""
    return {"L": model.prior_root}


def represent_root(model, x, P):
    """The mean and the root L of P."""
    return x, model.extras["L"]


def propagate_root(model, x, L, u):
    """Propagate mean and root by one substep."""
    return wrap(model.f(x, u), model.state_angles), model.F(x, u) @ L


def add_process_noise_root(model, x, L):
    """Add Q at the end of a step."""
    L = triangle(hstack(L, model.Q_root))
    return x, square(L), {"L": L}


def update_root(model, x, P, z):
    """Update with the measurement z; NaN marks missing channels."""
    m, measured, L = len(z), present(z), model.extras["L"]
    H, R = mask_missing(measured, model.H(x)), uncorrelated(measured, model.R)
    v = mask_missing(measured, wrap(z - model.h(x), model.measurement_angles))
    both = triangle(vstack(hstack(root(R), H @ L), hstack(zeros(L, len(L), m), L)))
    return root_result(model, x, both, v, measured)


def root_result(model, x, both, v, measured):
    """The results of an update, from the triangle [[S^(1/2), 0], [K S^(1/2), L]]."""
    m = len(v)
    n = len(both) - m
    of_s, of_gain, L = part(both, 0, 0, m, m), part(both, m, 0, n, m), part(both, m, m, n, n)
    d = of_gain @ forward_quotient(of_s, v)
    L = triangle(after_reset(model, L, x, d)) if model.turns else L
    return move(model, x, d), square(L), v, square(of_s), density(v, factor_of(of_s), measured), {"L": L}


SQUARE_ROOT = Page(propagate_root, add_process_noise_root, update_root, represent_root, initial_root)


# The UD form of the Kalman filter carries a unit upper triangular U and a diagonal D with P = U D U', in one
# matrix with D on its diagonal:
#
#     predict: U D U' = [F U, Q^(1/2)] diag(D, I) [F U, Q^(1/2)]',  by Gram and Schmidt's method with these weights
#     update:  one channel of R^(-1/2) z after the other, each a scalar whose noise has variance one
#
# Source: Bierman (1977), Factorization Methods for Discrete Sequential Estimation, chapter V; Thornton (1976),
# "Triangular covariance factorizations for Kalman filtering".


def initial_ud(model):
    """The factors of the prior covariance."""
    return {"UD": roots.factors(model.prior_root)}


def represent_ud(model, x, P):
    """The mean and U; D is read from the extras."""
    return x, roots.unit_upper(model.extras["UD"])


def propagate_ud(model, x, U, u):
    """Propagate the mean and U by one substep."""
    return wrap(model.f(x, u), model.state_angles), model.F(x, u) @ U


def add_process_noise_ud(model, x, U):
    """Add Q at the end of a step."""
    UD = roots.weighted_factors(hstack(U, model.Q_root), model.extras["UD"])
    return x, square(roots.upper_root(UD)), {"UD": UD}


def update_ud(model, x, P, z):
    """Update with the measurement z; NaN marks missing channels."""
    measured, UD = present(z), model.extras["UD"]
    H, R_root = mask_missing(measured, model.H(x)), root(uncorrelated(measured, model.R))
    v = mask_missing(measured, wrap(z - model.h(x), model.measurement_angles))
    white = forward_quotient(R_root, H)
    of_s = triangle(hstack(R_root, H @ roots.upper_root(UD)))
    d = roots.measured_gain(UD, white) @ forward_quotient(R_root, v)
    UD = roots.measured_factors(UD, white)
    if model.turns:
        UD = roots.weighted_factors(after_reset(model, roots.unit_upper(UD), x, d), UD)
    return (
        move(model, x, d),
        square(roots.upper_root(UD)),
        v,
        square(of_s),
        density(v, factor_of(of_s), measured),
        {"UD": UD},
    )


UD = Page(propagate_ud, add_process_noise_ud, update_ud, represent_ud, initial_ud)


@dataclass(frozen=True, kw_only=True, eq=False)
class ExtendedKalmanFilter(PageFilter):
    """Extended Kalman filter.

        predict: x = f(x, u),  P = F P F' + Q,  F = df/dx at the last mean
        update:  v = z - h(x),  S = H P H' + R,  K = P H' S^-1,  H = dh/dx at the mean,
                 x += K v,  P = (I - K H) P (I - K H)' + K R K'  (Joseph)

    Attributes:
        form: form of the recursion: "covariance" as above, "square-root" or "ud", which keep twice the
            digits of P. The estimates are equal to rounding.

    Raises:
        ValueError: if the form is unknown.

    Source: Jazwinski (1970), Stochastic Processes and Filtering Theory, section 8.3.
    """

    name: ClassVar[str] = "ekf"
    takes_rotations: ClassVar[bool] = True
    page: ClassVar[Page] = Page(propagate, add_process_noise, update)
    forms: ClassVar[Mapping[str, Page]] = {"square-root": SQUARE_ROOT, "ud": UD}
    form: str = "covariance"

    def __post_init__(self):
        one_of("form", self.form, self.known_forms)


# The iterated extended Kalman filter: each iteration linearises the measurement at the last estimate.


def update_iterated(model, x, P, z):
    """Update with the measurement z, linearised again in each iteration; NaN marks missing channels."""
    measured, R, at, d, innovations = present(z), uncorrelated(present(z), model.R), x, None, []
    for i in range(model.own.iterations):
        model, z = model.at_measurement(z) if i == 1 else (model, z)
        H, y = mask_missing(measured, model.H(at)), model.h(at)
        on_tangent = y - H @ d if i else y
        H = reset_columns(model, H, x, d) if i else H
        v = mask_missing(measured, wrap(z - on_tangent, model.measurement_angles))
        S = sym(H @ P @ H.T + R)
        K = divide(P @ H.T, S)
        d = K @ v
        at = move(model, x, d)
        innovations.append((v, S))
    v, S = innovations[0]
    return at, reset(model, joseph(P, K, H, R), x, d), v, S, log_density(v, S, measured)


@dataclass(frozen=True, kw_only=True, eq=False)
class IteratedExtendedKalmanFilter(PageFilter):
    """Iterated extended Kalman filter: its update is Gauss and Newton's method for the most probable state.

        predict: that of the extended filter
        update:  x_0 = x,  then for i = 0, 1, ... with H = dh/dx at x_i and K = P H' (H P H' + R)^-1
                 x_{i+1} = x + K (z - h(x_i) - H (x - x_i)),
                 at last x = x_i,  P = (I - K H) P (I - K H)' + K R K'  (Joseph) with the last H and K

    The first iteration is the extended filter's update. Innovation, its covariance and the likelihood come from
    the first iteration, so that they assess the prediction. The number of iterations is fixed and there is no line
    search: full steps may overshoot if h is strongly nonlinear within the spread of the belief.

    Attributes:
        iterations: how often the measurement is linearised, 1 to 20; 1 is the extended filter.

    Raises:
        ValueError: if iterations is not a whole number from 1 to 20.

    Source: Bell, Cathey (1993), "The iterated Kalman filter update as a Gauss-Newton method", IEEE Trans.
    Automatic Control 38(2).
    """

    name: ClassVar[str] = "iekf"
    takes_rotations: ClassVar[bool] = True
    page: ClassVar[Page] = Page(propagate, add_process_noise, update_iterated)
    unrolled: ClassVar[tuple[str, ...]] = ("iterations",)
    iterations: int = 5

    def __post_init__(self):
        iterations = at_least("iterations", self.iterations, 1, MOST_ITERATIONS)
        object.__setattr__(self, "iterations", iterations)


# The extended Kalman filter with a fading memory: old measurements count less than its model says.


def add_process_noise_fading(model, x, P):
    """Scale P by a^2 and add Q, at the end of a step."""
    return x, sym(P * model.own.fading * model.own.fading + model.Q)


@dataclass(frozen=True, kw_only=True, eq=False)
class FadingMemoryFilter(PageFilter):
    """Extended Kalman filter with a fading memory.

        predict: x = f(x, u),  P = a^2 F P F' + Q;  update: the extended filter's

    A measurement k steps old has a^-2k times the weight that it has with a = 1. So the filter follows a model that
    drifts, even with Q = 0. P is the covariance of errors weighted in this way.

    Attributes:
        fading: a, from 1, the extended filter, to 10.

    Raises:
        ValueError: if fading is out of its range.

    Source: Sorenson, Sacks (1971), "Recursive fading memory filtering"; Simon (2006), Optimal State Estimation,
    section 7.4.
    """

    name: ClassVar[str] = "fading"
    takes_rotations: ClassVar[bool] = True
    page: ClassVar[Page] = Page(propagate, add_process_noise_fading, update)
    fading: float = 1.01

    def __post_init__(self):
        object.__setattr__(self, "fading", between("fading", self.fading, 1.0, 10.0))


# The Schmidt-Kalman filter: measurements do not correct considered states, but their uncertainty enters P.


def update_schmidt(model, x, P, z):
    """Update with the measurement z; NaN marks missing channels."""
    measured = present(z)
    H, R = mask_missing(measured, model.H(x)), uncorrelated(measured, model.R)
    v = mask_missing(measured, wrap(z - model.h(x), model.measurement_angles))
    S = sym(H @ P @ H.T + R)
    K = model.own.corrected @ divide(P @ H.T, S)
    d = K @ v
    return move(model, x, d), reset(model, joseph(P, K, H, R), x, d), v, S, log_density(v, S, measured)


@dataclass(frozen=True, kw_only=True, eq=False)
class SchmidtKalmanFilter(PageFilter):
    """Schmidt's extended Kalman filter, with states that are considered, not estimated.

        predict: the extended filter's
        update:  K = J P H' S^-1, where J is the identity without the considered states;
                 x += K v,  P = (I - K H) P (I - K H)' + K R K'

    A considered bias, which measurements barely determine or determine wrongly, keeps its prior, and P includes
    its uncertainty. Without considered states this is the extended filter.

    Attributes:
        considered: indices of these states, of components of the error in a state with rotations; -1 is the last.

    Raises:
        ValueError: if an index is not that of a state.

    Source: Schmidt (1966), "Application of state-space methods to navigation problems"; Simon (2006), Optimal
    State Estimation, section 10.1.
    """

    name: ClassVar[str] = "schmidt"
    takes_rotations: ClassVar[bool] = True
    page: ClassVar[Page] = Page(propagate, add_process_noise, update_schmidt)
    considered: Any = ()

    def __post_init__(self):
        considered = indices_of("considered", self.considered, self.model.t)
        object.__setattr__(self, "considered", considered)

    @cached_property
    def parameters(self) -> dict[str, Any]:
        """J."""
        return {"corrected": np.diag([float(i not in self.considered) for i in range(self.model.t)])}


# The H-infinity filter: it bounds the errors that the worst noise of a given size can cause.


def add_process_noise_h_infinity(model, x, P):
    """Add Q and guard against the worst noise, at the end of a step."""
    W, P = model.own.weights, sym(P + model.Q)
    D = eye(P) - sym(W @ P @ W.T) * model.own.theta
    return x, sym(P + sym(divide(P @ W.T, D) @ (W @ P)) * model.own.theta)


@dataclass(frozen=True, kw_only=True, eq=False)
class HInfinityFilter(PageFilter):
    """Extended H-infinity filter: it guards against the worst noise, not the mean one.

        predict: x = f(x, u),  P = F P F' + Q,  then P = (P^-1 - theta W'W)^-1
        update:  the extended filter's: P = (P^-1 + H' R^-1 H)^-1,  x += P H' R^-1 (z - h(x))

    W = diag(1/scale). For any noise w and v and any initial error e_0 the sum of |W e|^2 is less than 1/theta
    times the sum of e_0' P_0^-1 e_0, w' Q^-1 w and v' R^-1 v. With theta = 0 it is the extended filter; P and the
    gain grow with theta. P is larger than the covariance of random errors, so its NEES is below n. If theta is too
    large for P, for instance after many steps without a measurement, P^-1 - theta W'W is not positive: the filter
    restarts, and counts the restart. The prior is not changed.

    Attributes:
        theta: the bound, above 0.
        scale: (n,), of the errors, in their units; the prior's standard deviations if None.

    Raises:
        ValueError: if a number is not positive.

    Source: Simon (2006), Optimal State Estimation, eq. (11.89), in two steps; Banavar (1992), "A game theoretic
    approach to linear dynamic estimation".
    """

    name: ClassVar[str] = "h-infinity"
    takes_rotations: ClassVar[bool] = True
    page: ClassVar[Page] = Page(propagate, add_process_noise_h_infinity, update)
    theta: float = 0.01
    scale: Any = None

    def __post_init__(self):
        object.__setattr__(self, "theta", positive("theta", self.theta))
        if self.scale is not None:
            scale = vector("scale", self.scale, self.model.t)
            object.__setattr__(self, "scale", np.array([positive("scale", value) for value in scale]))

    @cached_property
    def parameters(self) -> dict[str, Any]:
        """Theta and W; a state whose scale is zero has no weight."""
        scale = np.sqrt(np.diag(self.model.prior_cov)) if self.scale is None else self.scale
        weights = np.divide(1.0, scale, out=np.zeros(self.model.t), where=scale > 0.0)
        return {"theta": self.theta, "weights": np.diag(weights)}

    @property
    def follows_from(self) -> Mapping[str, tuple[str, ...]]:
        """W follows from the prior's standard deviations unless there is a scale."""
        return {"weights": ("prior_cov",)} if self.scale is None else {}
