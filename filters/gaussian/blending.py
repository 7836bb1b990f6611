"""Moments and weights of a mixture of Gaussians, whose parts lie one behind the other in a row.

    mean = sum of w_k x_k,  P = sum of w_k (P_k + (x_k - mean)(x_k - mean)')
    w_k becomes w_k N(v_k; 0, S_k)/L,  L = sum of w_k N(v_k; 0, S_k)

Of states that turn, x_k - mean is the difference d_k of the tangent at the mean, which is where the sum of w_k d_k
is zero, and P_k comes from the tangent at x_k, by J_k P_k J_k' (`thruster_env.model.turns`).

Unbiased mixing of modes whose models lack states: a mode that lacks states s gets, before each mixture,

    mean (x, m_s),  covariance (P, 0; 0, P_s)

with m_s, P_s of the mixture of the modes that have s, w_i/(sum of their w): so the mixture's mean of s is m_s.
Covariances between states that the same modes lack stay; if modes that have s all weigh zero, so does s.

Source: Yuan, Bar-Shalom, Willett, Mozeson, Pollak, Hardiman (2012), "A multiple IMM estimation approach with
unbiased mixing for thrusting projectiles"; Granstrom, Willett, Bar-Shalom (2015), "Systematic approach to IMM
mixing for unequal dimension states".
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cache
from typing import NamedTuple

import numpy as np

from thruster_env.core.angles import angle_indices, whole_turns, wrapped
from thruster_env.core.matrices import quadratic_form
from thruster_env.core.sources import (
    Source,
    lower_pairs,
    matrix_reader,
    matrix_writer,
    vector_reader,
    vector_writer,
)
from thruster_env.model.traced import called_function
from thruster_env.model.turns import Turn, difference, inverse_reset_slopes, move, tangent_flags

ROUNDS = 12  # of the mean of rotations


class Parts(NamedTuple):
    """The layout of the parts of a mixture of Gaussians in a row."""

    first: int
    stride: int  # from one part to the next
    number: int


@cache
def blender(
    parts: Parts,
    size: int,
    x: int,
    p: int,
    angles: tuple[bool, ...],
    *,
    between: bool = True,
    wraps: bool = True,
    turns: tuple[Turn, ...] = (),
) -> Callable:
    """Return `blend(row, weights, target)`: write a mixture's mean and covariance from the offset `target` on.

    `x` and `p` are the offsets of mean and covariance within each part, `weights` that of the weights in the row.
    Angles of parts are put on one branch (`thruster_env.core.angles`); if it `wraps`, those of the mean lie in
    (-pi, pi]. Without the covariance `between` the parts the result is the sum of w_k P_k.
    """
    if turns:
        return turning_blender(parts, size, x, p, angles, turns)
    source = Source("blend", "row, weights, target", result=(size, size))
    mean, cov, d = source.local("m", size), source.local("c", size, size), source.local("d", size)
    each = f"for k in range({parts.number}):", f"part = {parts.first} + {parts.stride} * k"
    if not source.loops:
        source.line(
            " = ".join([*(mean[i] for i in range(size)), *(cov[i, j] for i, j in lower_pairs(size)), "0.0"])
        )
    has_weight = "if row[weights + k] != 0.0:"  # 0 times the square of a distant part may be NaN
    for _ in source.inside(each[0]):
        source.line(each[1])
        for _ in source.inside(has_weight):
            for i in source.range(size):
                source.line(f"{mean[i]} += row[weights + k] * row[part + {x + i}]")
    for _ in source.inside(each[0]):
        source.line(each[1])
        source.line("w = row[weights + k]")
        for _ in source.inside(has_weight):
            for i in source.range(size if between else 0):
                source.line(f"{d[i]} = row[part + {x + i}] - {mean[i]}")
            for i in source.range(size):
                for j in source.range(i + 1):
                    apart = f" + {d[i]} * {d[j]}" * between
                    source.line(f"{cov[i, j]} += w * (row[part + {p + i * size + j}]{apart})")
    for i in source.range(size):
        source.line(f"row[target + {i}] = {mean[i]}")
        for j in source.range(i + 1):
            source.line(f"row[target + {i * size + j + size}] = row[target + {j * size + i + size}] = {cov[i, j]}")
    blend = source.function()
    if not any(angles):
        return blend
    align, angle_places = part_aligner(parts, x, angles), angle_indices(angles)

    def blend_aligned(row, weights, target):
        align(row, weights)
        blend(row, weights, target)
        if wraps:
            for i in angle_places:
                row[target + i] = wrapped(row[target + i])

    return blend_aligned


@cache
def turning_blender(
    parts: Parts, n: int, x: int, p: int, angles: tuple[bool, ...], turns: tuple[Turn, ...]
) -> Callable:
    """`blender` of states that turn; the mean begins at the part with the largest weight.

    `ROUNDS` steps are enough for parts within a radian.
    """
    (first, stride, count), t = parts, n - len(turns)

    def between(x, u, c):
        return tuple(difference(x, u, turns))

    def further(x, u, c):
        return tuple(move(x, u, turns))

    def transposed_back(x, u, c):
        return tuple(zip(*inverse_reset_slopes(x, u, turns), strict=True))

    apart = called_function(between, "x, u, c", (n, n, 0), 0, (t,))
    moving = called_function(further, "x, u, c", (n, t, 0), 0, (n,))
    back = called_function(transposed_back, "x, u, c", (n, t, 0), 0, (t, t))
    state, tangent, cov = vector_reader(n), vector_reader(t), matrix_reader(t, t)
    store_state, store_tangent, store_cov = vector_writer(n), vector_writer(t), matrix_writer(t, t, 0)
    congruence, of_tangent = quadratic_form(t, t), angle_indices(tangent_flags(angles, turns))
    of_state = angle_indices(angles)

    def blend(row, weights, target):
        m, s, d, c = np.zeros(n), np.zeros(t), np.zeros(t), np.zeros(t * t)
        heaviest, out = 0, target + n
        for k in range(count):
            if row[weights + k] > row[weights + heaviest]:
                heaviest = k
        for i in range(n):
            m[i] = row[first + heaviest * stride + x + i]
        for _ in range(ROUNDS):
            for i in range(t):
                s[i] = 0.0
            for k in range(count):
                if row[weights + k] != 0.0:
                    part = first + k * stride + x
                    store_tangent(d, apart(state(row[part : part + n]), state(m), ()))
                    for i in of_tangent:
                        d[i] = wrapped(d[i])
                    for i in range(t):
                        s[i] += row[weights + k] * d[i]
            store_state(m, moving(state(m), tangent(s), ()))
        for i in range(t * t):
            row[out + i] = 0.0
        for k in range(count):
            if row[weights + k] != 0.0:
                part, of_cov = first + k * stride + x, first + k * stride + p
                store_tangent(d, apart(state(row[part : part + n]), state(m), ()))
                for i in of_tangent:
                    d[i] = wrapped(d[i])
                within = cov(row[of_cov : of_cov + t * t])
                store_cov(c, congruence(back(state(m), tangent(d), ()), within))
                for i in range(t):
                    for j in range(t):
                        row[out + i * t + j] += row[weights + k] * (c[i * t + j] + d[i] * d[j])
        for i in of_state:
            m[i] = wrapped(m[i])
        for i in range(n):
            row[target + i] = m[i]

    return blend


@cache
def part_aligner(parts: Parts, x_offset: int, angles: tuple[bool, ...]) -> Callable:
    """Return `align(row, weights)`: put angles of the vector x of all parts on one branch, around their mean."""
    (_, stride, count), angle_offsets = parts, angle_indices(angles, parts.first + x_offset)

    def align(row, weights):
        for i in angle_offsets:
            s = c = 0.0
            for k in range(count):
                s += row[weights + k] * np.sin(row[i + k * stride])
                c += row[weights + k] * np.cos(row[i + k * stride])
            middle = np.arctan2(s, c)
            for k in range(count):
                row[i + k * stride] -= whole_turns(row[i + k * stride] - middle)

    return align


@cache
def weigher(parts: Parts, level: int) -> Callable:
    """Return `weigh(row, weights)`: multiply weights by the parts' likelihoods; it returns the log of their sum.

    The weights before must not be zero.
    """
    (_, stride, count), first = parts, parts.first + level

    def weigh(row, weights):
        top = -math.inf
        for k in range(count):
            top = max(top, row[first + k * stride])
        total = 0.0
        for k in range(count):
            row[weights + k] *= math.exp(row[first + k * stride] - top)
            total += row[weights + k]
        for k in range(count):
            row[weights + k] /= total
        return top + math.log(total) if total > 0.0 else -math.inf

    return weigh


@cache
def log_weigher(parts: Parts, level: int) -> Callable:
    """Return `weigh(row, logs, weights)`: `weigher` for weights that are carried from step to step as logarithms.

    The logarithms begin at `logs`; a weight of zero, with the logarithm -inf, stays zero. A weight that is too
    small for a float64 keeps its logarithm, so that its part regains weight as soon as measurements support it.
    """
    (_, stride, count), first = parts, parts.first + level

    def weigh(row, logs, weights):
        top = -math.inf
        for k in range(count):
            row[logs + k] += row[first + k * stride]
            top = max(top, row[logs + k])
        total = 0.0
        for k in range(count):
            row[weights + k] = math.exp(row[logs + k] - top)
            total += row[weights + k]
        log_total = top + math.log(total) if total > 0.0 else -math.inf
        for k in range(count):
            row[weights + k] /= total
            row[logs + k] -= log_total
        return log_total

    return weigh


def logarithm(weight):
    """The logarithm of a weight, -inf of zero."""
    return math.log(weight) if weight > 0.0 else -math.inf


def parts_of(extras: np.ndarray, number: int, n: int, t: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Means (number, n), covariances (number, t, t) and weights, or their logarithms, of a belief's parts."""
    parts, weights = np.split(extras, [-number])
    means, covs, _ = np.split(parts.reshape(number, -1), [n, n + t * t], axis=1)
    return means.copy(), covs.reshape(number, t, t).copy(), weights.copy()


def nothing(memory, inputs, numbers):
    """Do nothing: the function before the first of several."""


class Absent(NamedTuple):
    """States that some modes lack.

    Attributes:
        states: their indices.
        modes: the modes that lack them.
        from_prior: whether they get the prior moments of these modes' models, not moments of the other modes.
    """

    states: tuple[int, ...]
    modes: tuple[int, ...]
    from_prior: bool


def absent_states(
    states_of_modes: Sequence[tuple[int, ...]], n: int, moments_known: Sequence[int]
) -> tuple[Absent, ...]:
    """The states, of n, that modes with `states_of_modes` lack, in groups that the same modes lack.

    A state of `moments_known` is a group of its own.
    """
    lacking: dict[tuple, list[int]] = {}
    for state in range(n):
        modes = tuple(k for k, states in enumerate(states_of_modes) if state not in states)
        if modes:
            lacking.setdefault((modes, state if state in moments_known else -1), []).append(state)
    return tuple(Absent(tuple(states), modes, state >= 0) for (modes, state), states in lacking.items())


def completer(
    absent: tuple[Absent, ...],
    parts: Parts,
    n: int,
    blend: Callable,
    priors: Sequence[tuple[int, int]],
    scratch: int,
) -> Callable:
    """Return `complete(row, weights, numbers)`: fill in the states that parts lack, by unbiased mixing.

    Mean and covariance come first in each part. `priors` are the offsets of the prior mean and covariance of each
    mode's model in the filter's numbers; from `scratch` on the row has room for weights, a mean and a covariance.
    """
    complete = nothing
    for group in absent:
        if group.from_prior:
            complete = _from_prior(complete, group, parts, n, priors)
        else:
            complete = _of_others(complete, group, parts, n, blend, scratch)
    return complete


def _from_prior(
    before: Callable, absent: Absent, parts: Parts, n: int, priors: Sequence[tuple[int, int]]
) -> Callable:
    """Fill in a state with the prior's moments of the modes' models."""
    (state,), (first, stride, _) = absent.states, parts
    offsets = tuple(
        (first + k * stride, priors[k][0] + state, priors[k][1] + state * (n + 1)) for k in absent.modes
    )

    def complete(row, weights, numbers):
        before(row, weights, numbers)
        for part, mean, variance in offsets:
            row[part + state] = numbers[mean]
            for t in range(n):
                row[part + n + state * n + t] = row[part + n + t * n + state] = 0.0
            row[part + n + state * (n + 1)] = numbers[variance]

    return complete


def _of_others(before: Callable, absent: Absent, parts: Parts, n: int, blend: Callable, scratch: int) -> Callable:
    """Fill in states with their moments in the mixture of the other modes."""
    (states, modes, _), (first, stride, count), moments = absent, parts, scratch + parts.number

    def complete(row, weights, numbers):
        before(row, weights, numbers)
        total = 0.0
        for k in range(count):
            row[scratch + k] = 0.0 if k in modes else row[weights + k]
            total += row[scratch + k]
        if total > 0.0:
            for k in range(count):
                row[scratch + k] /= total
            blend(row, scratch, moments)
            for k in modes:
                part = first + k * stride
                for s in states:
                    row[part + s] = row[moments + s]
                    for t in range(n):
                        row[part + n + s * n + t] = row[part + n + t * n + s] = 0.0
                for s in states:
                    for t in states:
                        row[part + n + s * n + t] = row[moments + n + s * n + t]

    return complete
