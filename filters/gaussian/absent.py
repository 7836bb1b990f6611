"""Unbiased mixing: parts of a mixture that lack a state are completed by the parts that have it.

Each mode of a filter of several models has a row for all states; those that it lacks take no part in its filter.
With the weights w_i of the modes, before each mixture,

    m_s, P_s = mean and covariance of the states s in the mixture of the modes that have them, w_i/(sum of their w)
    a mode that lacks s:  mean (x, m_s),  covariance (P, 0; 0, P_s)

so that the mixture's mean of s is m_s, whatever the weight of modes that say nothing of it. States that the same
modes lack keep their covariances. Where modes that have s have no weight at all, s stays as it is.

Source: Yuan, Bar-Shalom, Willett, Mozeson, Pollak, Hardiman (2012), "A multiple IMM estimation approach with
unbiased mixing for thrusting projectiles"; Granstrom, Willett, Bar-Shalom (2015), "Systematic approach to IMM
mixing for unequal dimension states".
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

from thruster_env.numerics.compiled import inlined


class Absent(NamedTuple):
    """States that some modes lack.

    Attributes:
        states: their places.
        modes: which modes lack them.
        given: whether they have the prior's moments of these modes' models there, in place of the others'.
    """

    states: tuple[int, ...]
    modes: tuple[int, ...]
    given: bool


def absent_states(places: Sequence[tuple[int, ...]], n: int, given: Sequence[int]) -> tuple[Absent, ...]:
    """What modes lack that have the states at some places, of n; states of the same modes together.

    Those in `given` stand alone.
    """
    found: dict[tuple, list[int]] = {}
    for state in range(n):
        modes = tuple(k for k, own in enumerate(places) if state not in own)
        if modes:
            found.setdefault((modes, state if state in given else -1), []).append(state)
    return tuple(Absent(tuple(states), modes, state >= 0) for (modes, state), states in found.items())


class Parts(NamedTuple):
    """Places of a mixture in a row: of the first part, the distance to the next, their number, and scratch."""

    means: int
    covs: int
    weights: int
    stride: int
    number: int
    scratch: int  # number + n + n * n


def completer(
    absent: tuple[Absent, ...],
    parts: Parts,
    n: int,
    blend: Callable,
    store: tuple[Callable, Callable],
    priors: Sequence[tuple[int, int]],
) -> Callable:
    """Return `complete(row, numbers)`: give all parts all states; see this module.

    Args:
        absent: what modes lack.
        parts: where the mixture is in the row.
        n: number of states.
        blend: `blend(row, count)`, mean and covariance of the mixture by its weights.
        store: functions (row, mean) and (row, covariance) that write to the beginning of a row.
        priors: places of the prior mean and covariance of each mode's model in the filter's numbers.
    """
    complete = _nothing
    for one in absent:
        work = _given(one, parts, n, priors) if one.given else _of_others(one, parts, n, blend, store)
        complete = _both(complete, work)
    return complete


@inlined
def _nothing(row, numbers):
    """Before the first states that some modes lack."""


def _both(first: Callable, then: Callable) -> Callable:
    @inlined
    def both(row, numbers):
        first(row, numbers)
        then(row, numbers)

    return both


def _given(absent: Absent, parts: Parts, n: int, priors: Sequence[tuple[int, int]]) -> Callable:
    """A state with the moments of the modes' own models."""
    (state,), means, covs = absent.states, parts.means, parts.covs
    places = tuple((k * parts.stride, priors[k][0] + state, priors[k][1] + state * (n + 1)) for k in absent.modes)

    @inlined
    def work(row, numbers):
        for part, mean, variance in places:
            row[part + means + state] = numbers[mean]
            for t in range(n):
                row[part + covs + state * n + t] = row[part + covs + t * n + state] = 0.0
            row[part + covs + state * (n + 1)] = numbers[variance]

    return work


def _of_others(
    absent: Absent, parts: Parts, n: int, blend: Callable, store: tuple[Callable, Callable]
) -> Callable:
    """States with the moments that they have in the mixture of the other modes."""
    means, covs, weights, stride, count, kept = parts
    states, modes, (store_mean, store_cov) = absent.states, absent.modes, store
    begin, end = kept + count, kept + count + n + n * n
    have = tuple(0.0 if k in modes else 1.0 for k in range(count))

    @inlined
    def work(row, numbers):
        total = 0.0
        for k in range(count):
            row[kept + k] = row[weights + k * stride]
            row[weights + k * stride] *= have[k]
            total += row[weights + k * stride]
        if total > 0.0:
            for k in range(count):
                row[weights + k * stride] /= total
            mean, p = blend(row, count)
            moments = row[begin:end]
            store_mean(moments, mean)
            store_cov(moments, p)
            for k in modes:
                part = k * stride
                for s in states:
                    row[part + means + s] = row[begin + s]
                    for t in range(n):
                        row[part + covs + s * n + t] = row[part + covs + t * n + s] = 0.0
                for s in states:
                    for t in states:
                        row[part + covs + s * n + t] = row[begin + n + s * n + t]
        for k in range(count):
            row[weights + k * stride] = row[kept + k]

    return work
