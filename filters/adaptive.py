"""Filters that estimate the noise online or down-weight outliers: variational Bayes, Sage-Husa, Student-t."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from filters.algebra.matrices import shifted
from filters.algebra.operations import (
    choose,
    constant,
    count,
    divide,
    exceeds,
    eye,
    is_number,
    joseph,
    mask_missing,
    present,
    sym,
    trace,
    uncorrelated,
    wrap,
)
from filters.algebra.points import log_density, outer
from filters.algebra.tangents import move, reset
from filters.engine.belief import Belief
from filters.filter import PageFilter
from filters.gaussian.extended import add_process_noise, propagate
from filters.pages.page import Page
from thruster_env.core.checks import at_least, finite, positive

MOST_ITERATIONS = 50  # which programs repeat without a loop


def noise_moment(measured, HPH, R, v):
    """E[v v' | z] of v ~ N(0, R) in z = h(x) + v, for the part H P H' of S and an innovation.

    With S = H P H' + R and G = R S^-1: E[v | z] = G innovation, and in Joseph's form cov(v | z) is (I - G) R (I -
    G)' + G H P H' G'; the moment is always positive definite. Missing channels carry no information; their part of
    the moment follows from the others through R.
    """
    G = divide(mask_missing(measured, R).T, sym(HPH + uncorrelated(measured, R)))
    A, e = eye(R) - G, G @ v
    return outer(e, e) + sym(A @ R @ A.T) + sym(G @ HPH @ G.T)


def bounded_step(A, more, less, d):
    """A + d (more - less), with d limited to 1/(2 trace(A^-1 less)).

    With A positive definite, and `more` and `less` positive semidefinite, `less` is at most trace(A^-1 less) A, so
    the result is at least A/2. A matrix A that is not positive definite stays as it is.
    """
    size = trace(divide(less, A))
    d = choose(exceeds(d * size, 0.5), 0.5 / size, d)
    return choose(is_number(size), A + (more - less) * d, A)


def part_that_is_kept(name: str, value) -> float:
    """Return value as a float; raise ValueError unless it is above 0 and at most 1."""
    factor = finite(name, value)
    if not 0.0 < factor <= 1.0:
        raise ValueError(f"{name} must be above 0 and at most 1, but got {factor}")
    return factor


# The variational Bayesian filter: an extended Kalman filter with an inverse Wishart belief of R.


def initial_variational(model):
    """The initial distribution of R: its mean is the model's R."""
    return {"V": model.R * model.own.prior_weight, "nu": model.own.prior_weight}


def update_variational(model, x, P, z):
    """Update with the measurement z; NaN marks missing channels."""
    rho, V, nu, measured = model.own.forgetting_factor, model.extras["V"], model.extras["nu"], present(z)
    H = mask_missing(measured, model.H(x))
    v, HPH = mask_missing(measured, wrap(z - model.h(x), model.measurement_angles)), sym(H @ P @ H.T)
    R, later = V / nu, rho * nu + 1.0
    S = HPH + uncorrelated(measured, R)
    for _ in range(model.own.iterations):
        R = (V * rho + noise_moment(measured, HPH, R, v)) / later
    used = uncorrelated(measured, R)
    K, any_measured = divide(P @ H.T, HPH + used), exceeds(count(measured), 0.0)
    extras = {"V": choose(any_measured, R * later, V), "nu": choose(any_measured, later, nu)}
    d = K @ v
    P = reset(model, joseph(P, K, H, used), x, d)
    return move(model, x, d), P, v, S, log_density(v, S, measured), extras


@dataclass(frozen=True, kw_only=True, eq=False)
class VariationalBayesFilter(PageFilter):
    """Extended Kalman filter that also estimates R, by an inverse Wishart distribution.

        predict: the extended filter's
        update:  repeat R = (rho V + E[v v' | z])/(rho nu + 1), each moment under the R before, then
                 V = rho V + E[v v' | z],  nu = rho nu + 1, and mean and P as in the extended filter with this R

    V (m, m) and nu are the parameters of the distribution of R; the estimate of R is 1/E[1/R] = V/nu. For one
    channel this is the inverse gamma distribution with alpha = nu/2, beta = V/2. The repetition is the fixed-point
    iteration of the variational approximation in which state and R are independent. Innovation, S and
    log-likelihood use the R that was estimated before the measurement. In a missing channel E[v v' | z] follows
    from the others by their correlation in R.

    `Belief.extras` holds V (m m numbers), then nu.

    Attributes:
        forgetting_factor: rho, above 0 and at most 1; the estimate of R averages about the last 1/(1 - rho)
            measurements.
        prior_weight: initial nu: the model's R has the weight of this many measurements; with rho = 1 and a large
            weight the filter becomes the extended one.
        iterations: of the fixed point, 1 to 50.

    Raises:
        ValueError: if a parameter is out of its range.

    Source: Sarkka, Nummenmaa (2009), "Recursive noise adaptive Kalman filtering by variational Bayesian
    approximations", IEEE Trans. Automatic Control 54(3); with inverse Wishart Sarkka, Hartikainen (2013),
    "Non-linear noise adaptive Kalman filtering via variational Bayes".
    """

    name: ClassVar[str] = "vb"
    takes_rotations: ClassVar[bool] = True
    page: ClassVar[Page] = Page(propagate, add_process_noise, update_variational, initial=initial_variational)
    unrolled: ClassVar[tuple[str, ...]] = ("iterations",)
    varying_noise: ClassVar[bool] = False  # R is in the belief, and starts at the model's
    forgetting_factor: float = 0.99
    prior_weight: float = 10.0
    iterations: int = 3

    def __post_init__(self):
        factor = part_that_is_kept("forgetting_factor", self.forgetting_factor)
        object.__setattr__(self, "forgetting_factor", factor)
        object.__setattr__(self, "prior_weight", positive("prior_weight", self.prior_weight))
        object.__setattr__(self, "iterations", at_least("iterations", self.iterations, 1, MOST_ITERATIONS))

    @property
    def fixed_noise(self) -> tuple[str, ...]:
        """R, because the filter estimates it."""
        return ("R",)

    def estimated_noise(self, belief: Belief) -> np.ndarray:
        """The estimate V/nu of R (m, m) in a belief."""
        m = self.model.m
        extras = belief.extras[self.model.any_shape.feed :]
        return extras[: m * m].reshape(m, m) / extras[m * m]


# A robust extended Kalman filter: Student-t measurement noise, so that outliers have little weight.


def initial_robust(model):
    """The weight without a measurement, 1."""
    return {"weight": constant(1.0, model.own.degrees_of_freedom)}


def update_robust(model, x, P, z):
    """Update with the measurement z; NaN marks missing channels."""
    d, measured, weight = model.own.degrees_of_freedom, present(z), 1.0
    H, R = mask_missing(measured, model.H(x)), uncorrelated(measured, model.R)
    v, HPH = mask_missing(measured, wrap(z - model.h(x), model.measurement_angles)), sym(H @ P @ H.T)
    S = HPH + R
    for _ in range(model.own.iterations):
        E = mask_missing(measured, noise_moment(measured, HPH, R / weight, v))
        weight = (d + count(measured)) / (d + trace(divide(E, R)))
    R = R / weight
    K = divide(P @ H.T, HPH + R)
    change = K @ v
    P = reset(model, joseph(P, K, H, R), x, change)
    return move(model, x, change), P, v, S, log_density(v, S, measured), {"weight": weight}


@dataclass(frozen=True, kw_only=True, eq=False)
class RobustExtendedKalmanFilter(PageFilter):
    """Extended Kalman filter for Student-t measurement noise: outliers have little weight.

        predict: the extended filter's
        update:  from weight = 1 repeat  weight = (d + m)/(d + trace(R^-1 E[v v' | z])), each moment with R/weight
                 in place of R; then the extended filter's update, also with R/weight in place of R

    The noise v has d degrees of freedom and scale matrix R: it is N(0, R/weight) for a weight that is gamma
    distributed about 1. The repetition is the fixed-point iteration of the variational approximation in which
    state and weight are independent; m counts the measured channels, which share one weight. Innovation, S and
    log-likelihood use R itself, so that outliers are visible in the NIS (normalised innovation squared).

    `Belief.extras` holds the last weight, near 0 for an outlier, and 1 if nothing was measured.

    Attributes:
        degrees_of_freedom: d, positive; as it grows the filter becomes the extended one.
        iterations: of the fixed point, 1 to 50.

    Raises:
        ValueError: if a parameter is out of its range.

    Source: Agamennoni, Nieto, Nebot (2012), "Approximate inference in state-space models with heavy-tailed noise",
    IEEE Trans. Signal Processing 60(10), section III; Piche, Sarkka, Hartikainen (2012), "Recursive outlier-robust
    filtering and smoothing for nonlinear systems using the multivariate Student-t distribution".
    """

    name: ClassVar[str] = "ekf-robust"
    takes_rotations: ClassVar[bool] = True
    page: ClassVar[Page] = Page(propagate, add_process_noise, update_robust, initial=initial_robust)
    unrolled: ClassVar[tuple[str, ...]] = ("iterations",)
    degrees_of_freedom: float = 4.0
    iterations: int = 5

    def __post_init__(self):
        object.__setattr__(self, "degrees_of_freedom", positive("degrees_of_freedom", self.degrees_of_freedom))
        object.__setattr__(self, "iterations", at_least("iterations", self.iterations, 1, MOST_ITERATIONS))


# Sage and Husa's adaptive filter: an extended Kalman filter that estimates R online, and optionally Q.


def initial_sage_husa(model):
    """The model's R and Q, and the flag that there was no prediction yet."""
    return {"R": model.R, "Q": model.Q, "predicted": constant(0.0, model.own.forgetting_factor)}


def add_process_noise_sage_husa(model, x, P):
    """Add the estimated Q at the end of a step."""
    Q = model.extras["Q"] if model.own.learns_q else model.Q
    return x, sym(P + Q), {"Q": Q, "predicted": constant(1.0, model.own.forgetting_factor)}


def update_sage_husa(model, x, P, z):
    """Update with the measurement z, then update R and Q; NaN marks missing channels."""
    measured, R, Q, old = present(z), model.extras["R"], model.extras["Q"], P
    H, used = mask_missing(measured, model.H(x)), uncorrelated(measured, R)
    v = mask_missing(measured, wrap(z - model.h(x), model.measurement_angles))
    S = sym(H @ P @ H.T + used)
    K = divide(P @ H.T, S)
    correction, P, of_seen = K @ v, joseph(P, K, H, used), sym(mask_missing(measured, mask_missing(measured, S).T))
    for_r, for_q = (shifted(factor * -1.0, 1.0) for factor in model.own[:2])
    R = choose(exceeds(for_r, 0.0), bounded_step(R, outer(v, v), of_seen, for_r), R)
    if model.own.learns_q:  # K v v' K' from the correction of x, K S K' from the reduction of P
        after = bounded_step(Q, outer(correction, correction), old - P, for_q)
        Q = choose(exceeds(model.extras["predicted"], 0.0), after, Q)
    extras = {"R": R, "Q": Q, "predicted": constant(0.0, for_r)}
    P = reset(model, P, x, correction)
    return move(model, x, correction), P, v, S, log_density(v, S, measured), extras


@dataclass(frozen=True, kw_only=True, eq=False)
class SageHusaFilter(PageFilter):
    """Extended Kalman filter that estimates R, and optionally Q, from its innovations, with fading memory.

        predict, update: the extended filter's, with the estimates of Q and R in place of the model's
        after an update: R = a R + (1 - a)(i i' - H P H') = R + (1 - a)(i i' - S),  i the innovation
                         Q = Q + (1 - b) K (i i' - S) K' = b Q + (1 - b)(K i i' K' + P_new - F P_old F')

    with P before the update in the first line, P_new after it and P_old before the prediction in the second. If S
    is the covariance of the innovation, the mean change is zero. Because i i' - H P H' may be indefinite, a step
    R + d (i i' - S) is limited to d = 1/(2 trace(R^-1 S)), which leaves at least half of R, and likewise for Q:
    both stay positive definite by construction. A missing channel does not change its row and column of R. One
    channel can rarely distinguish Q from R: with b = 1 Q stays the model's, and a singular Q always does.

    `Belief.extras` holds R (m m numbers), Q (n n), and 1 between a prediction and its update, else 0.

    Attributes:
        forgetting_factor: a, above 0 and at most 1; the estimate of R averages about the last 1/(1 - a)
            measurements; with a = 1 it stays the model's R.
        process_forgetting_factor: b, above 0 and at most 1.

    Raises:
        ValueError: if a factor is not above 0 and at most 1.

    Source: Sage, Husa (1969), "Adaptive filtering with unknown prior statistics"; Mehra (1972), "Approaches to
    adaptive filtering", IEEE Trans. Automatic Control 17(5), on matching covariances. The bound on d is ours.
    """

    name: ClassVar[str] = "sage-husa"
    takes_rotations: ClassVar[bool] = True
    page: ClassVar[Page] = Page(
        propagate, add_process_noise_sage_husa, update_sage_husa, initial=initial_sage_husa
    )
    varying_noise: ClassVar[bool] = False  # R, and Q if it is estimated, are in the belief
    any_step: ClassVar[bool] = False  # it estimates the Q of a step
    forgetting_factor: float = 0.995
    process_forgetting_factor: float = 1.0

    def __post_init__(self):
        for name in ("forgetting_factor", "process_forgetting_factor"):
            object.__setattr__(self, name, part_that_is_kept(name, getattr(self, name)))

    @property
    def learns_q(self) -> bool:
        """Whether the filter estimates Q, too."""
        return self.process_forgetting_factor < 1.0

    @property
    def fixed_noise(self) -> tuple[str, ...]:
        """The covariances that the filter estimates."""
        return ("Q", "R") if self.learns_q else ("R",)

    @property
    def written_page(self) -> Page:
        """The page, with or without the estimation of Q."""
        return super().written_page._replace(fixed=(("learns_q", self.learns_q),))

    def estimated_noise(self, belief: Belief) -> np.ndarray:
        """The estimate of R (m, m) in a belief."""
        m = self.model.m
        first = self.model.any_shape.feed
        return belief.extras[first : first + m * m].reshape(m, m).copy()

    def estimated_process_noise(self, belief: Belief) -> np.ndarray:
        """The estimate of Q (n, n) in a belief, of errors if the state has rotations."""
        n, first = self.model.t, self.model.any_shape.feed + self.model.m**2
        return belief.extras[first : first + n * n].reshape(n, n).copy()
