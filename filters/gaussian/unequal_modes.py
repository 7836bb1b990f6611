"""Unbiased mixing of modes whose models lack states.

A mode whose model lacks states s gets, before each mixture of weights w_i,

    mean (x, m_s),  covariance (P, 0; 0, P_s)

with m_s, P_s of the mixture of the modes that have s, w_i/(sum of their w): so the mixture's mean of s is m_s.
Covariances between states that the same modes lack stay; if modes that have s all weigh zero, so does s.

Source: Yuan, Bar-Shalom, Willett, Mozeson, Pollak, Hardiman (2012), "A multiple IMM estimation approach with
unbiased mixing for thrusting projectiles"; Granstrom, Willett, Bar-Shalom (2015), "Systematic approach to IMM
mixing for unequal dimension states".
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

from filters.gaussian.mixtures import Parts, nothing


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
