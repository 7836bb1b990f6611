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

from filters.gaussian.mixtures import Parts, nothing
from thruster_env.core.compiled import inlined


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


def completer(
    absent: tuple[Absent, ...],
    parts: Parts,
    n: int,
    blend: Callable,
    priors: Sequence[tuple[int, int]],
    scratch: int,
) -> Callable:
    """Return `complete(row, weights, numbers)`: give all parts all states; see this module.

    Mean and covariance come first in each part. `priors` are the places of the prior mean and covariance of each
    mode's model in the filter's numbers; from `scratch` on there is room for weights, a mean and a covariance.
    """
    complete = nothing
    for one in absent:
        if one.given:
            complete = _given(complete, one, parts, n, priors)
        else:
            complete = _of_others(complete, one, parts, n, blend, scratch)
    return complete


def _given(before: Callable, absent: Absent, parts: Parts, n: int, priors: Sequence[tuple[int, int]]) -> Callable:
    """A state with the moments of the modes' own models."""
    (state,), (first, stride, _) = absent.states, parts
    places = tuple(
        (first + k * stride, priors[k][0] + state, priors[k][1] + state * (n + 1)) for k in absent.modes
    )

    @inlined
    def complete(row, weights, numbers):
        before(row, weights, numbers)
        for part, mean, variance in places:
            row[part + state] = numbers[mean]
            for t in range(n):
                row[part + n + state * n + t] = row[part + n + t * n + state] = 0.0
            row[part + n + state * (n + 1)] = numbers[variance]

    return complete


def _of_others(before: Callable, absent: Absent, parts: Parts, n: int, blend: Callable, scratch: int) -> Callable:
    """States with the moments that they have in the mixture of the other modes."""
    (states, modes, _), (first, stride, count), moments = absent, parts, scratch + parts.number

    @inlined
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
