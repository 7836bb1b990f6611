"""The rank histogram filter, and recording the members of an ensemble after every step."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np

from filters.engine.session import Session
from filters.ensembles.by_parts import LocalisedByParts, look
from filters.ensembles.ensemble import EnsembleFilter, add_process_noise, propagate
from filters.filter import Filter
from filters.pages.page import Page
from thruster_env.core.checks import at_least
from thruster_env.core.compiled import inlined
from thruster_env.core.streams import below, quantile


@inlined
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


@inlined
def ranked_moves(y, v, tail, moves, size):
    """Moves of a channel's y (N,), with R = 1, for a measurement v: to the quantiles of its posterior."""
    order, squares = np.argsort(y), 0.0
    for j in range(size):
        squares += y[j] ** 2
        moves[j] = 0.0
    spread = (squares / (size - 1)) ** 0.5
    if not 0.0 < spread < np.inf:
        return
    share = math.log(size + 1.0)  # of the prior's bins between members
    masses = np.empty(size + 1)
    masses[0], left, left_deviation = tail_mass(y[order[0]], spread, tail, v)
    masses[size], right, right_deviation = tail_mass(-y[order[size - 1]], spread, tail, -v)
    for i in range(1, size):
        a, b = -0.5 * (y[order[i - 1]] - v) ** 2, -0.5 * (y[order[i]] - v) ** 2
        most = max(a, b)
        masses[i] = most + math.log(0.5 * (math.exp(a - most) + math.exp(b - most))) - share
    most, total = masses.max(), 0.0
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
            z = quantile(part / masses[0] * below((y[order[0]] - left) / left_deviation))
            new = left + left_deviation * z
        elif bin_ == size:
            rest = max(masses[size] - part, 0.0) / masses[size]
            z = quantile(rest * below((-y[order[size - 1]] - right) / right_deviation))
            new = -(right + right_deviation * z)
        else:
            low, high = y[order[bin_ - 1]], y[order[bin_]]
            new = low + (high - low) * part / masses[bin_]
        moves[order[rank]] = new - y[order[rank]]


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


# The members of an ensemble filter after every step, which `filters.run` does not keep.


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
    steps = np.arange(at_least("first", first, 0), times, at_least("every", every, 1))
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
