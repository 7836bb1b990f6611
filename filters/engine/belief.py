"""Beliefs: the values, their layout in memory, checks of arguments, and the restart of a diverged one.

A filter's memory is a row of small parts (belief, innovation, scratch), a table with one column per ensemble
member, and a vector of random draws. Rows are cheap to pass to compiled code, to copy and to stack. The row of
numbers has those of the model, laid out by `thruster_env.model.shape`, then the filter's parameters.

Estimates within bounds on the states, by truncated moments or by projection, for any filter of one Gaussian.

The filter itself continues with the unconstrained belief x, P; only the estimates that it returns are constrained:

- truncation: the moments of the normal distribution within the bounds. If the truncated state i, with s^2 = P_ii,
  has the mean mu and the variance v in units of s: x += P_i mu/s, P += P_i P_i' (v - 1)/s^2. For several bounded
  states this is repeated until it converges, each time for one state without its own bound and with all other
  bounds (expectation propagation).
- projection: the x within the bounds with the smallest (x - x_f)' P^-1 (x - x_f), where x_f is the filter's mean;
  P is unchanged.

If the filter continued with the constrained belief, a bound would count again in each step: the estimate of a
constant would drift away from it.

Source: Simon, Simon (2010), "Constrained Kalman filtering via density function truncation for turbofan engine
health estimation"; Simon (2010), "Kalman filtering with state constraints: a survey"; for several states
Cunningham, Hennig, Lacoste-Julien (2011), "Gaussian probabilities and expectation propagation"; for the quadratic
programme Hildreth (1957), "A quadratic programming procedure".
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, lru_cache
from math import inf, isfinite, sqrt
from typing import NamedTuple

import numpy as np

from thruster_env.core.checks import ROUNDING, as_floats, at_least, covariance, short_repr
from thruster_env.core.compiled import is_interpreting
from thruster_env.core.streams import truncated_normal
from thruster_env.model.quantities import Bound
from thruster_env.model.shape import NumberOffsets, Shape, number_offsets, starts_of


class Belief(NamedTuple):
    """The estimate of a filter at one time.

    Attributes:
        mean: of the state, (n,), in the units of the model.
        cov: covariance of the error, (n, n).
        members: of an ensemble, (n, N), one row for each state; N = 0 for Gaussian filters. Particle filters add a
            row of log weights.
        key: two integers; with `step` they determine all random draws.
        step: number of steps predicted so far.
        divergences: restarts from the prior after an estimate that was not finite.
        extras: what the filter keeps besides, such as an estimate of R.
    """

    mean: np.ndarray
    cov: np.ndarray
    members: np.ndarray
    key: tuple[int, int]
    step: int
    divergences: int
    extras: np.ndarray = np.empty(0)


class OwnBelief(Belief):
    """A belief that a session made: as long as nobody writes to its arrays it needs no checks.

    Attributes:
        origin: the kernels that made it, then its mean and covariance, and its extras, as bytes; None of a belief
            with replaced parts.
    """

    origin: tuple[Kernels, bytes, bytes] | None = None

    def __repr__(self) -> str:
        """That of a belief."""
        return repr(Belief(*self))

    def __reduce__(self) -> tuple:
        """Copies and pickles are beliefs without an origin."""
        return Belief, tuple(self)


class LostBelief(Belief):
    """The result of `predict` if it is not finite; the next update restarts from the prior."""

    __slots__ = ()


class Innovation(NamedTuple):
    """Innovation of an update: measurement minus its prediction.

    Attributes:
        value: z - E[z], (m,), in the units of the measurements; zero in missing channels.
        cov: its covariance S, (m, m).
        log_likelihood: log N(value; 0, S) of the channels that were measured.
    """

    value: np.ndarray
    cov: np.ndarray
    log_likelihood: float


class Kernels(NamedTuple):
    """A kind of filter for one shape of model, as plain functions on its memory.

    `row` is laid out by `filters.engine.belief`, `numbers` by `thruster_env.model.shape`; `table` is
    (table_rows, padded size), its first n rows the members, without columns for filters without an ensemble;
    `draws` has room for `draws_per_member` normals a member. Besides mean and covariance a belief keeps the first
    `kept_rows` rows of the table and `extras` values of the row, from `memory_offsets(n, m).extras` on; then come
    `scratch` values that it does not keep.

    If h takes the input, `acting` are the places in the row of the last step's, perhaps several times; they are
    among the extras, and zero at the start.

    `vectors`, if there are any, are four functions (rows, given, numbers) for eight beliefs side by side: the
    parts of `predict` before its substeps, in each substep and after them, and `update`. Batches run these
    (`engine.compile.build_batch`).
    """

    n: int
    m: int
    table_rows: int
    draws_per_member: int
    start: Callable  # start(memory, numbers, size): belief = prior; memory = (row, table, draws)
    predict: Callable  # predict(memory, u, numbers, size)
    update: Callable  # update(memory, z, numbers, size); a NaN in z is a missing channel
    summarise: Callable  # summarise(memory, size): mean and cov from the members; `update` does it itself
    extras: int = 0
    extra_kept_rows: int = 0  # rows of the table, after the n of members, that belong to the belief
    scratch: int = 0
    vectors: tuple[Callable, ...] = ()
    acting: tuple[int, ...] = ()
    turns: int = 0  # rotations: rows of the covariance are so many fewer than states
    measured_turns: int = 0  # rotations among measurements, which have so many numbers more than innovations

    @property
    def t(self) -> int:
        """Rows of the covariance."""
        return self.n - self.turns

    @property
    def channels(self) -> int:
        """Numbers of a measurement."""
        return self.m + self.measured_turns

    @property
    def layout(self) -> MemoryOffsets:
        """Offsets in the row."""
        return memory_offsets(self.n, self.m, self.t)

    @property
    def offsets(self) -> NumberOffsets:
        """Offsets of the model's numbers."""
        return number_offsets(self.n, self.m, self.t)

    @property
    def kept_rows(self) -> int:
        """Rows of the table that belong to the belief."""
        return self.n + self.extra_kept_rows


# Layout of the memory of a filter.


class MemoryOffsets(NamedTuple):
    """Offsets of the parts of a filter's row, for n states, m measurements and errors with t components."""

    mean: int  # (n,)
    cov: int  # (t, t)
    key_0: int
    key_1: int
    step: int  # steps taken
    divergences: int  # restarts after an estimate that was not finite
    innovation: int  # (m,)
    innovation_cov: int  # (m, m)
    log_likelihood: int
    gain: int  # (n, m), scratch
    extras: int  # of a kind of filter, then its scratch: the end of the row


@cache
def memory_offsets(n: int, m: int, t: int | None = None) -> MemoryOffsets:
    """Offsets in the row of a filter; t = n if None."""
    tt = n * n if t is None else t * t
    return MemoryOffsets(*starts_of(n, tt, 1, 1, 1, 1, m, m * m, 1, n * m))


def filter_offset(shape: Shape) -> int:
    """Offset of the filter's own parameters in the packed row, behind those of its model."""
    return shape.offsets.constants + shape.constants


# Checks of the arguments of filters: beliefs, keys, inputs and measurements.

FEW = 4  # states, up to which Python checks a belief faster than NumPy


def vector_like(name: str, value, like: np.ndarray, *, missing_allowed: bool) -> np.ndarray:
    """Return value as float64 of the shape of `like`; raise ValueError for a wrong shape or infinite entries."""
    try:
        array = np.atleast_1d(as_floats(value))
    except ValueError:
        array = np.full(like.size + 1, np.nan)
    wrong = np.isinf(array) if missing_allowed else ~np.isfinite(array)
    if array.shape != like.shape or wrong.any():
        rule = "finite or NaN" if missing_allowed else "finite"
        if not like.size:
            raise ValueError(f"{name} must be empty, because the model has no inputs, but got {short_repr(value)}")
        count = f"{like.size} number{'' if like.size == 1 else 's'}"
        raise ValueError(f"{name} must be {count}, each {rule}, but got {short_repr(value)}")
    return array


def checked_key(key) -> tuple[int, int]:
    """Return a key as two integers; raise ValueError unless they are whole numbers below 2^32."""
    if type(key) is tuple and len(key) == 2 and all(type(word) is int and 0 <= word < 2**32 for word in key):
        return key
    try:
        words = [int(word) for word in as_floats(key)] if np.shape(key) == (2,) else []
        if len(words) == 2 and words == list(key) and min(words) >= 0 and max(words) < 2**32:
            return words[0], words[1]
    except (TypeError, ValueError, OverflowError):
        pass
    raise ValueError(f"key must be two whole numbers from 0 to 2^32 - 1, but got {short_repr(key)}")


def checked_actions(actions, count: int, size: int, ignored=False) -> np.ndarray:
    """Return the actions of `count` envs as (count, size); raise ValueError unless they are numbers, none NaN.

    Rows where `ignored` (count,) is true are not checked.
    """
    try:
        array = as_floats(actions)
    except ValueError:
        array = np.empty(0)
    whose = f"the {count} actions" if count > 1 else "an action"
    numbers = f"{size} number{'' if size == 1 else 's'}"
    if array.size != count * size:
        raise ValueError(f"{whose} must be {numbers}{' each' * (count > 1)}, but got {short_repr(actions)}")
    array = array.reshape(count, size)
    if (np.isnan(array).any(axis=1) & ~np.asarray(ignored)).any():
        raise ValueError(f"{whose} must be {numbers} and not NaN, but got {short_repr(actions)}")
    return array


def check_belief(belief: Belief, prior_variances: np.ndarray) -> None:
    """Raise ValueError unless a belief's numbers are finite and its covariance is positive semidefinite.

    Rounding may leave errors relative to its variances, or to the prior's (n,), from which a filter starts. A
    `LostBelief`, which declares that it is not finite, passes.
    """
    if _passes_quickly(belief, prior_variances):
        return
    at_least("step of a belief", belief.step, 0)
    at_least("divergences of a belief", belief.divergences, 0)
    if isinstance(belief, LostBelief):
        return
    # Particle filters keep log weights behind the members of their states; those, and extras, may be infinite.
    finite = {"mean": belief.mean, "members": belief.members[: len(belief.mean)]}
    for name, values in finite.items():
        if not np.isfinite(as_floats(values)).all():
            raise ValueError(f"{name} of a belief must be finite, but got {short_repr(values)}")
    for name in ("members", "extras"):
        if np.isnan(as_floats(getattr(belief, name))).any():
            raise ValueError(f"{name} of a belief must not be NaN, but got {short_repr(getattr(belief, name))}")
    covariance("cov of a belief", belief.cov, len(prior_variances), variances=prior_variances)


def _passes_quickly(belief: Belief, prior_variances: np.ndarray) -> bool:
    """Whether a belief passes all checks, by a quick test; if not, the thorough checks find what is wrong.

    P + r V = L L' with L real, where V has the variances or the prior's, and r is the tolerance: so no eigenvalue
    of V^(-1/2) P V^(-1/2) is below -r.
    """
    mean, cov, members, extras = belief.mean, belief.cov, belief.members, belief.extras
    if not all(type(array) is np.ndarray and array.dtype == np.float64 for array in (mean, cov, members, extras)):
        return False
    if type(belief.step) is not int or type(belief.divergences) is not int or min(belief[4:6]) < 0:
        return False
    n = len(mean)
    if members.size:
        if not np.abs(members[:n]).sum() < np.inf or np.isnan(members[n:]).any():
            return False
    if extras.size and np.isnan(extras).any():
        return False
    if n > FEW:
        return _many(mean, cov, prior_variances)
    return _few(mean.tolist(), cov.tolist(), prior_variances.tolist())


def _few(mean: list[float], cov: list[list[float]], prior_variances: list[float]) -> bool:
    """`_many` for a few states, for which NumPy's calls take longer than their arithmetic."""
    if not isfinite(sum(mean)):
        return False
    root: list[list[float]] = []
    for i, row in enumerate(cov):
        new: list[float] = []
        for j in range(i):
            if row[j] != cov[j][i]:
                return False
            rest = row[j]
            for k in range(j):
                rest -= new[k] * root[j][k]
            new.append(rest / root[j][j])
        pivot = row[i] + ROUNDING * max(row[i], prior_variances[i])
        if pivot == 0.0 and not any(row):  # of what is known exactly
            pivot = 1.0
        for entry in new:
            pivot -= entry * entry
        if not (row[i] >= 0.0 and 0.0 < pivot < inf):
            return False
        new.append(sqrt(pivot))
        root.append(new)
    return True


def _many(mean: np.ndarray, cov: np.ndarray, prior_variances: np.ndarray) -> bool:
    """Whether a mean is finite and a covariance symmetric and positive semidefinite, by its Cholesky factor."""
    variances = cov.diagonal()
    if not np.abs(mean).sum() + np.abs(cov).sum() < np.inf or not (cov == cov.T).all() or variances.min() < 0:
        return False
    shifted, known = cov.copy(), ~cov.any(axis=1)  # what is known exactly has a variance of 0 and no covariance
    shifted.ravel()[:: len(cov) + 1] += np.where(known, 1.0, ROUNDING * np.maximum(variances, prior_variances))
    try:
        np.linalg.cholesky(shifted)
    except np.linalg.LinAlgError:
        return False
    return True


# Restart of a belief that has diverged (not finite, or with a negative variance): it becomes the prior.

LARGEST = 1e300  # of the sum of a belief's absolute numbers


@lru_cache(maxsize=64)
def restart_if_lost(kernels: Kernels) -> Callable:
    """Return `restart(memory, numbers, size)`: replace a diverged belief by the prior, and count the restart."""
    m, start, summarise = kernels.m, kernels.start, kernels.summarise
    layout, r_offset = kernels.layout, kernels.offsets.r
    innovation, s_offset, log_likelihood = layout.innovation, layout.innovation_cov, layout.log_likelihood
    divergences, cov, end, t = layout.divergences, layout.cov, layout.gain, kernels.t

    def restart(memory, numbers, size):
        row, _, _ = memory
        total, least = 0.0, 0.0
        for i in range(end):
            total += abs(row[i])
        for i in range(t):  # of which rounding may leave one negative in a covariance of very unequal numbers
            least = min(least, row[cov + i * (t + 1)])
        if not (total < LARGEST and least >= 0.0):
            start(memory, numbers, size)
            summarise(memory, size)
            row[divergences] += 1.0
            row[log_likelihood] = 0.0
            for i in range(m):
                row[innovation + i] = 0.0
            for i in range(m * m):
                row[s_offset + i] = numbers[r_offset + i]

    return restart


TRUNCATION, PROJECTION = "truncation", "projection"
ROUNDS = 10_000  # at most, over all bounds
ENOUGH, SETTLED = 1e-14, 1e-10  # last changes of projection and of truncation, in standard deviations
LEAST = 1e-12  # fraction of a variance that truncation leaves at least


@lru_cache(maxsize=64)
def bounded_kernels(kernels: Kernels, bounds: tuple[Bound, ...], bounded_by: str) -> Kernels:
    """Kernels of the same filter with mean and covariance within bounds.

    Its unconstrained mean (n,) and covariance (n, n) are the last of `Belief.extras`.
    """
    n, layout = kernels.n, memory_offsets(kernels.n, kernels.m)
    mean, free = layout.mean, layout.extras + kernels.extras + kernels.scratch
    size = n + n * n  # mean and covariance are neighbours
    plain_start, plain_predict, plain_update = kernels.start, kernels.predict, kernels.update
    constrain = _constraint(n, mean, layout.cov, bounds, bounded_by)

    def tell(row):
        for i in range(size):
            row[free + i] = row[mean + i]
        constrain(row)

    def recall(row):
        for i in range(size):
            row[mean + i] = row[free + i]

    def start(memory, numbers, size):
        plain_start(memory, numbers, size)
        tell(memory[0])

    def predict(memory, u, numbers, size):
        recall(memory[0])
        plain_predict(memory, u, numbers, size)
        tell(memory[0])

    def update(memory, z, numbers, size):
        recall(memory[0])
        plain_update(memory, z, numbers, size)
        tell(memory[0])

    extras = kernels.extras + kernels.scratch + size
    return kernels._replace(start=start, predict=predict, update=update, extras=extras, scratch=0, vectors=())


def constrained(
    means: np.ndarray, covs: np.ndarray, bounds: tuple[Bound, ...], bounded_by: str
) -> tuple[np.ndarray, np.ndarray]:
    """Means (..., n) and covariances (..., n, n) within bounds, from those of unconstrained Gaussians."""
    n = means.shape[-1]
    rows = np.concatenate([means.reshape(-1, n), covs.reshape(-1, n * n)], axis=1)
    _constrain_rows(n, bounds, bounded_by, is_interpreting())(rows)
    return rows[:, :n].reshape(means.shape), rows[:, n:].reshape(covs.shape)


@lru_cache(maxsize=64)
def _constrain_rows(n: int, bounds: tuple[Bound, ...], bounded_by: str, interpreting: bool) -> Callable:
    from thruster_env.graphs.loops import Loops

    constrain = _constraint(n, 0, n, bounds, bounded_by)

    def constrain_rows(rows):
        for i in range(len(rows)):
            constrain(rows[i])

    return Loops(constrain_rows, [(None, n + n * n)])


def _constraint(n: int, mean: int, cov: int, bounds: tuple[Bound, ...], bounded_by: str) -> Callable:
    """The function that constrains the mean and the covariance at these offsets of a row."""
    states, low, high = (tuple(getattr(bound, name) for bound in bounds) for name in ("place", "low", "high"))
    return (_truncation if bounded_by == TRUNCATION else _projection)(n, mean, cov, states, low, high)


def _truncation(n: int, mean: int, cov: int, states: tuple, low: tuple, high: tuple) -> Callable:
    def constrain(row):
        # A state's bounds act as a Gaussian factor: a precision and an information. The cavity is without it.
        column, precisions, informations = np.zeros(n), np.zeros(len(states)), np.zeros(len(states))
        for _ in range(ROUNDS if len(states) > 1 else 1):
            largest = 0.0
            for b in range(len(states)):
                i = states[b]
                x, p = row[mean + i], row[cov + i * n + i]
                precision = 1.0 / p - precisions[b] if p > 0.0 else 0.0
                if precision > 0.0:
                    s, cavity = precision**-0.5, (x / p - informations[b]) / precision
                    shift, variance = truncated_normal((low[b] - cavity) / s, (high[b] - cavity) / s)
                    new_x, new_p = cavity + s * shift, max(s * s * variance, LEAST * p)
                    for j in range(n):
                        column[j] = row[cov + j * n + i] / p
                    for j in range(n):
                        row[mean + j] += column[j] * (new_x - x)
                        for k in range(n):
                            row[cov + j * n + k] += column[j] * column[k] * (new_p - p)
                    row[mean + i], row[cov + i * n + i] = min(max(new_x, low[b]), high[b]), new_p
                    precisions[b], informations[b] = 1.0 / new_p - precision, new_x / new_p - cavity * precision
                    largest = max(largest, abs(new_x - x) / p**0.5, abs(new_p / p - 1.0))
            if not largest > SETTLED:
                break
        for b in range(len(states)):
            row[mean + states[b]] = min(max(row[mean + states[b]], low[b]), high[b])

    return constrain


def _projection(n: int, mean: int, cov: int, states: tuple, low: tuple, high: tuple) -> Callable:
    def constrain(row):
        forces = np.zeros(len(states))  # x = x_f + P (the forces at the bounds), each zero or at its bound
        for _ in range(ROUNDS):
            largest = 0.0
            for b in range(len(states)):
                i = states[b]
                p = row[cov + i * n + i]
                if p > 0.0:
                    without = row[mean + i] - p * forces[b]
                    force = (min(max(without, low[b]), high[b]) - without) / p
                    change = force - forces[b]
                    for j in range(n):
                        row[mean + j] += row[cov + j * n + i] * change
                    forces[b] = force
                    largest = max(largest, abs(change) * np.sqrt(p))
            if not largest > ENOUGH:
                break
        for b in range(len(states)):
            row[mean + states[b]] = min(max(row[mean + states[b]], low[b]), high[b])

    return constrain
