"""Ensemble filters without perturbed measurements: ETKF, LETKF, EnSRF, EnKF-N and the rank histogram filter.

`record_members` keeps the members of any ensemble filter after every step.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from filters.algebra.members import mean
from filters.algebra.operations import (
    at_least,
    choose,
    constant,
    count,
    divide,
    exceeds,
    exponential,
    eye,
    geometric_mean,
    present,
    sym,
    trace,
)
from filters.algebra.points import dot, root
from filters.algebra.roots import triangle_quotient
from filters.engine.session import Session
from filters.ensembles.ensemble import EnsembleFilter, add_process_noise, compare, propagate
from filters.ensembles.stochastic import DeterministicUpdateFilter, LocalisedByParts, gaussian_moves, look
from filters.filter import Filter
from filters.pages.page import Page
from thruster_env.core.checks import at_least as check_at_least
from thruster_env.core.checks import positive
from thruster_env.core.streams import below, quantile

ROUNDS = 8  # of Newton's method; innovations of up to two standard deviations need six
FLATTEST = 0.25  # smallest slope by which a round divides


def update_transform(model, x, z, e):
    """Update with the measurement z, by the symmetric square root; NaN marks missing channels."""
    d, C, v, S, R, level = compare(model, x, z)
    return x + (divide(C, S) @ v - divide(C, S + geometric_mean(R, S)) @ d), v, S, level


@dataclass(frozen=True, kw_only=True, eq=False)
class EnsembleTransformFilter(DeterministicUpdateFilter):
    """Ensemble transform Kalman filter (ETKF) with the symmetric square root, without perturbed measurements.

        predict: x_j = f(x_j, u) + w_j,  w_j ~ N(0, Q)
        update:  y_j = h(x_j),  innovation = z - mean(y),  X (n, N) and Y (m, N) the distances from the means,
                 mean(x) += X T^2 Y' R^-1 innovation/(N - 1),  X = X T,  T = (I + Y' R^-1 Y/(N - 1))^-1/2

    T is symmetric, so that it keeps the mean exactly and moves the members as little as possible. It is N x N and
    never formed. With S = Y Y'/(N - 1) + R and the geometric mean R # S = R (R^-1 S)^1/2 of the two, which is the
    root of R S for one channel, T = I - Y' (S + R # S)^-1 Y/(N - 1) and X T = X - cov(x, y) (S + R # S)^-1 Y.

    The covariance after an update is exactly P - K S K', where the stochastic filter's is so on average only; the
    mean moves as the Kalman filter's. The update draws nothing: only the process noise of the members is random,
    and the error of its sample mean and covariance enters the estimate. Attributes are those of
    `DeterministicUpdateFilter`.

    Source: Bishop, Etherton, Majumdar (2001), "Adaptive sampling with the ensemble transform Kalman filter", part
    I; the symmetric root: Hunt, Kostelich, Szunyogh (2007), "Efficient data assimilation for spatiotemporal chaos:
    a local ensemble transform Kalman filter", section 2.3, here without localisation, which the
    `LocalEnsembleTransformFilter` has.
    """

    name: ClassVar[str] = "etkf"
    page: ClassVar[Page] = Page(propagate, add_process_noise, update_transform)


@dataclass(frozen=True, kw_only=True, eq=False)
class LocalEnsembleTransformFilter(LocalisedByParts, EnsembleTransformFilter):
    """Local ensemble transform Kalman filter (LETKF): each state has its own analysis, with the channels near it.

        predict: x_j = f(x_j, u) + w_j,  w_j ~ N(0, Q)
        update:  state i is moved as by the `EnsembleTransformFilter` with R_kk/taper(distance of i and k) in
                 place of each R_kk (R-localisation), by Gaspari and Cohn's taper; tapers below 0.001 are zero

    N members span N - 1 directions, which are enough for a field of any length if distant states are not
    correlated. The model has the positions of its states and measurements (`Positions`); without a radius this is
    the `EnsembleTransformFilter`. Innovation, its covariance and log-likelihood are those without tapers.

    Attributes:
        radius: at which a channel counts about 0.6 times, in the unit of the positions; 0 for no localisation. The
            others are those of `DeterministicUpdateFilter`.

    Raises:
        ValueError: if a parameter is out of its range; for a radius also if the model has no positions.

    Source: Hunt, Kostelich, Szunyogh (2007), "Efficient data assimilation for spatiotemporal chaos: a local
    ensemble transform Kalman filter".
    """

    name: ClassVar[str] = "letkf"


def update_serial(model, x, z, e):
    """Update with the measurement z, as by one channel after the other; NaN marks missing channels."""
    d, C, v, S, R, level = compare(model, x, z)
    K, L, M = divide(C, S), root(S), root(R)
    return x + (K @ v - triangle_quotient(K @ L, L + M) @ d), v, S, level


@dataclass(frozen=True, kw_only=True, eq=False)
class SerialSquareRootFilter(LocalisedByParts):
    """Serial ensemble square root filter (EnSRF), without perturbed measurements.

        predict: x_j = f(x_j, u) + w_j,  w_j ~ N(0, Q)
        update:  y_j = M^-1 h(x_j) and z = M^-1 z, M the lower triangular root of R: channels with independent
                 noise of variance 1; then for one channel i after the other, in x and in the remaining channels,
                 s = var(y_i) + 1,  k = cov(x, y_i)/s,  mean += k (z_i - mean(y_i)),
                 x_j - mean(x) -= k (y_ij - mean(y_i))/(1 + s^-1/2);  sample covariances with divisor N - 1

    For all channels at once that is x_j += K innovation - K L (L + M)^-1 (h(x_j) - mean(h)), with L the lower
    triangular root of S = cov(h, h) + R: Andrews' square root, because eliminating one channel after the other
    yields L. The filter computes this. The covariance after an update is exactly P - K S K', which the stochastic
    filter attains only on average; the mean moves as in the Kalman filter. The update draws nothing: only the
    process noise of the members is random, and the error of its sample mean and covariance enters the estimate.

    With one channel it is the `EnsembleTransformFilter`. Close relatives are called EnKF-SR in the literature on
    ships.

    With a radius the gain k of a state is tapered by its distance from the channel (P-localisation), and each
    channel is predicted again from the members after the update by earlier channels.

    Attributes:
        radius: of Gaspari and Cohn's taper, in the unit of the model's `Positions`; 0 for no localisation. The
            others are those of `DeterministicUpdateFilter`.

    Raises:
        ValueError: if a parameter is out of its range; for a radius also if the model has no positions.

    Source: Whitaker, Hamill (2002), "Ensemble data assimilation without perturbed observations", equations (10) to
    (13); Andrews (1968), "A square root formulation of the Kalman covariance equations"; with tapers: Karspeck,
    Anderson (2007), "Experimental implementation of an ensemble adjustment filter for an intermediate ENSO model".
    """

    name: ClassVar[str] = "ensrf"
    page: ClassVar[Page] = Page(propagate, add_process_noise, update_serial)
    moves_of: ClassVar[Callable | None] = staticmethod(gaussian_moves)


def variance_factor(parameters, A, R, v):
    """The factor t on the covariance A of y that minimises J(t)."""
    L = root(A)
    B = divide(L.T, R)
    G, g = sym(B @ L), B @ v
    unit = eye(G)
    shift = exponential((trace(divide(G, unit + G)) / parameters.size - 1.0) * parameters.log_mode)
    low, high = parameters.low * shift, parameters.high / shift
    t, least = constant(1.0, parameters.size), low / high
    for _ in range(ROUNDS):
        of = unit + G * t
        q = divide(g, of)  # t q'q is the square of the members' weights
        rest = t - (low + t * t * dot(q, q) / parameters.degrees) / high
        slope = 1.0 - t * 2.0 * dot(q, divide(q, of)) / (parameters.degrees * high)
        t = t - rest / at_least(slope, FLATTEST)
        t = choose(exceeds(t - least, 0.0), t, least)
    return t


def update_finite_size(model, x, z, e):
    """Inflate, then update with the measurement z; NaN marks missing channels."""
    d, C, v, S, R, level = compare(model, x, z)
    t = variance_factor(model.own, S - R, R, v)
    t = choose(exceeds(count(present(z)), 0.0), t, constant(1.0, t))
    spread, C, total = t**0.5, C * t, (S - R) * t + R
    x = x + (x - mean(x)) * (spread - 1.0)
    return x + (divide(C, total) @ v - divide(C, total + geometric_mean(R, total)) @ (d * spread)), v, S, level


@dataclass(frozen=True, kw_only=True, eq=False)
class FiniteSizeEnsembleFilter(DeterministicUpdateFilter):
    """Finite-size ensemble Kalman filter (EnKF-N): the ensemble transform filter with estimated inflation.

        predict: x_j = f(x_j, u) + w_j,  w_j ~ N(0, Q)
        update:  y_j = h(x_j),  A = cov(y, y),  v = z - mean(y);  t > 0 where
                 J(t) = v' (t A + R)^-1 v/(N - 1) + a/t + b log t  is least;
                 x_j = mean + t^1/2 (x_j - mean);  then the update of the `EnsembleTransformFilter`
        with     a = certainty (1 + 1/N) c,  b = certainty N/((N - 1) c),  c = (1 - 1/N^2)^(-r/2),
                 r = 1 - trace(A (A + R)^-1)/N

    N members determine mean and covariance of the forecast only roughly. With Jeffreys' prior for both, the
    forecast is not Gaussian; its mode is that of a Gaussian with t times the sample covariance. So inflation need
    not be tuned for the sampling error; Q still covers errors of the model. J is in the dual form; c makes t = 1
    if measurements carry no information. Eight rounds of Newton's method start at t = 1; they converge except for
    a few per cent of innovations beyond some four standard deviations.

    The innovation, its covariance and the log-likelihood are those before the inflation, because that depends on
    z.

    Attributes:
        certainty: of the ensemble's covariance: 1 for members that are like independent draws, as for a chaotic or
            noisy plant; with more, t varies less. The others are those of `DeterministicUpdateFilter`.

    Raises:
        ValueError: if a parameter is out of its range.

    Source: Bocquet (2011), "Ensemble Kalman filtering without the intrinsic need for inflation"; the dual form:
    Bocquet, Raanes, Hannart (2015), "Expanding the validity of the ensemble Kalman filter without the intrinsic
    need for inflation"; certainty and c as in Raanes, Bocquet, Carrassi (2019), "Adaptive covariance inflation in
    the ensemble Kalman filter by Gaussian scale mixtures".
    """

    name: ClassVar[str] = "enkf-n"
    page: ClassVar[Page] = Page(propagate, add_process_noise, update_finite_size)
    certainty: float = 1.0

    def __post_init__(self):
        super().__post_init__()
        object.__setattr__(self, "certainty", positive("certainty", self.certainty))

    @property
    def parameters(self) -> Mapping[str, Any]:
        """Those of all ensembles, and the constants of J."""
        size = self.ensemble_size
        parameters = super().parameters
        return {
            **{name: value for name, value in parameters.items() if name != "certainty"},
            "size": size,
            "degrees": size - 1,
            "low": self.certainty * (size + 1) / size,
            "high": self.certainty * size / (size - 1),
            "log_mode": 0.5 * math.log1p(-1.0 / size**2),
        }


def tail_mass(edge, spread, tail, z):
    """The posterior tail below an edge: its log mass without the prior's scale, its mean and standard deviation.

    The prior is normal with the members' standard deviation; its mass below the edge is the normal distribution
    function of `tail`.
    """
    centre, total = edge - tail * spread, spread * spread + 1.0
    mean, deviation = (centre + z * spread * spread) / total, spread / total**0.5
    part = below((edge - mean) / deviation)
    level = -0.5 * ((z - centre) ** 2 / total + math.log(total))
    return (level + math.log(part) if part > 0.0 else -np.inf), mean, deviation


def sort_order(y, order, merged, size):
    """Set `order` (N,) to the indices of y (N,) from the least on, by merging sorted runs in `merged` (N,)."""
    for j in range(size):
        order[j] = j
    width = 1
    while width < size:
        for first in range(0, size, 2 * width):
            left, right = first, min(first + width, size)
            middle, end = right, min(first + 2 * width, size)
            for k in range(first, end):
                if left < middle and (right == end or y[int(order[left])] <= y[int(order[right])]):
                    merged[k] = order[left]
                    left += 1
                else:
                    merged[k] = order[right]
                    right += 1
        for j in range(size):
            order[j] = merged[j]
        width *= 2


def ranked_moves(y, v, tail, moves, size):
    """Moves of a channel's y (N,), with R = 1, for a measurement v: to the quantiles of its posterior."""
    order, squares = np.empty(size), 0.0
    sort_order(y, order, moves, size)
    for j in range(size):
        squares += y[j] ** 2
        moves[j] = 0.0
    spread = (squares / (size - 1)) ** 0.5
    if not 0.0 < spread < np.inf:
        return
    least, largest = int(order[0]), int(order[size - 1])
    share = math.log(size + 1.0)  # of the prior's bins between members
    masses = np.empty(size + 1)
    masses[0], left, left_deviation = tail_mass(y[least], spread, tail, v)
    masses[size], right, right_deviation = tail_mass(-y[largest], spread, tail, -v)
    for i in range(1, size):
        a, b = -0.5 * (y[int(order[i - 1])] - v) ** 2, -0.5 * (y[int(order[i])] - v) ** 2
        most = max(a, b)
        masses[i] = most + math.log(0.5 * (math.exp(a - most) + math.exp(b - most))) - share
    most, total = masses[0], 0.0
    for i in range(1, size + 1):
        most = max(most, masses[i])
    for i in range(size + 1):
        masses[i] = math.exp(masses[i] - most)
        total += masses[i]
    bin_, before = 0, 0.0  # the bin in which a quantile lies, and the mass before it
    for rank in range(size):
        wanted = total * (rank + 1.0) / (size + 1.0)
        while bin_ < size and before + masses[bin_] <= wanted:
            before += masses[bin_]
            bin_ += 1
        part = wanted - before
        if bin_ == 0:
            z = quantile(part / masses[0] * below((y[least] - left) / left_deviation))
            new = left + left_deviation * z
        elif bin_ == size:
            rest = max(masses[size] - part, 0.0) / masses[size]
            z = quantile(rest * below((-y[largest] - right) / right_deviation))
            new = -(right + right_deviation * z)
        else:
            low, high = y[int(order[bin_ - 1])], y[int(order[bin_])]
            new = low + (high - low) * part / masses[bin_]
        member = int(order[rank])
        moves[member] = new - y[member]


@dataclass(frozen=True, kw_only=True, eq=False)
class RankHistogramFilter(LocalisedByParts):
    """Rank histogram filter (RHF): the predicted measurement may have any density, which its members determine.

        predict: x_j = f(x_j, u) + w_j,  w_j ~ N(0, Q)
        update:  channel by channel, with y_j = h(x_j): the prior has the mass 1/(N + 1) between two neighbours,
                 uniformly, and below the least and above the largest y, as tails of a normal density with their
                 standard deviation; the posterior is this times the likelihood, for a bin the mean at its ends;
                 the y of rank k moves to its quantile k/(N + 1), by d_j;  x_j += cov(x, y) d_j/var(y)

    Two separate clouds of members stay separate, while a Kalman gain moves all members alike. States move by
    linear regression on the channel. Channels with correlated noise are first made independent, by the lower
    triangular root of R. The innovation, its covariance and the log-likelihood are Gaussian, as for other
    ensembles. The update is neither in C nor on tensors.

    Attributes:
        radius: of Gaspari and Cohn's taper on the regression, in the unit of the model's `Positions`; 0 for no
            localisation. The others are those of `DeterministicUpdateFilter`.

    Raises:
        ValueError: if a parameter is out of its range; for a radius also if the model has no positions.

    Source: Anderson (2010), "A non-Gaussian ensemble filter update for data assimilation".
    """

    name: ClassVar[str] = "rhf"
    page: ClassVar[Page] = Page(propagate, add_process_noise, look)
    moves_of: ClassVar[Callable | None] = staticmethod(ranked_moves)

    @property
    def by_parts(self) -> bool:
        """Always."""
        return True


class Members(NamedTuple):
    """Ensembles of B runs after some of the measurements."""

    members: np.ndarray  # (B, T, n, N)
    weights: np.ndarray | None  # (B, T, N) with sum 1; None where all members weigh the same
    steps: np.ndarray  # (T,), indices of these measurements


def record_members(
    filter_: Filter,
    keys: np.ndarray,
    inputs: np.ndarray,
    measurements: np.ndarray,
    *,
    first: int = 0,
    every: int = 1,
) -> Members:
    """Run an ensemble filter over trajectories and keep its members.

    The members are those of `filters.run` with the same arguments. All ensembles of a long batch take much memory,
    8 B T n N bytes. For a rank histogram some tens of runs and a part of their steps are enough.

    Args:
        filter_: a filter with an ensemble.
        keys: (B, 2).
        inputs: (B, K, p).
        measurements: (B, K + 1, m), NaN where missing.
        first: index of the first measurement after which members are kept.
        every: number of measurements from one set of members to the next.

    Raises:
        ValueError: if the filter has no ensemble, or a number is wrong.
    """
    if filter_.size == 0:
        raise ValueError(f"members need a filter with an ensemble, but got {filter_.name!r}")
    session, n = Session(filter_), filter_.kernel_model.n
    count, times = measurements.shape[:2]
    steps = np.arange(check_at_least("first", first, 0), times, check_at_least("every", every, 1))
    rows = n if isinstance(filter_, EnsembleFilter) else n + 1  # particles have weights
    members = np.empty((count, len(steps), rows, filter_.size))
    for b in range(count):
        session.start(keys[b], measurements[b, 0])
        for k in range(times):
            if k > 0:
                session.step(inputs[b, k - 1], measurements[b, k])
            index, off = divmod(k - first, every)
            if index >= 0 and off == 0:
                members[b, index] = filter_.sample(session.belief())
    if rows == n:
        return Members(members, None, steps)
    weights = np.exp(
        members[:, :, n] - members[:, :, n].max(axis=-1, keepdims=True)
    )  # row n holds their logarithms
    return Members(members[:, :, :n], weights / weights.sum(axis=-1, keepdims=True), steps)
