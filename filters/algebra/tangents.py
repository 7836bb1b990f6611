"""Operations of pages on states with rotations: the steps of `thruster_env.model.turns`, on matrices.

Of a model without rotations each is the plain operation: a sum, or nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np

from filters.algebra.matrices import operation, same
from filters.algebra.operations import sym, wrap
from thruster_env.graphs.graphs import Number
from thruster_env.graphs.tracing import traced
from thruster_env.model import turns as steps

_traced = cache(traced)


def _computed(function: Callable, turns: Any, *vectors: Any) -> np.ndarray:
    """A function of sequences of components, and of the rotations, for arrays of floats or of Numbers."""
    if vectors[0].dtype != object:
        return np.array(function(*vectors, turns))
    for number in np.concatenate(vectors):
        if isinstance(number, Number):
            number.graph.whole.add(number.place)  # its own operations may be rounded as they like
    return np.array(_traced(function)(*map(list, vectors), turns), dtype=object)


def move(model, x, d):
    """The state x moved by d of its tangent: x + d with wrapped angles, q exp(d) or exp(d) q of a rotation."""
    return wrap(moved(x, d, model.turns) if model.turns else x + d, model.state_angles)


def difference(model, x, y):
    """The d of the tangent at y with move(model, y, d) = x: x - y, and the logarithm of a rotation."""
    return wrap(x - y, model.state_angles) if not model.turns else apart(x, y, model.turns)


def reset(model, p, d):
    """G P G': a covariance about x in the tangent at move(model, x, d); see `thruster_env.model.turns`."""
    if not model.turns:
        return p
    G = reset_slopes(d, model.turns)
    return sym(G @ p @ G.T)


def reset_columns(model, h, d):
    """H G: a Jacobian by the tangent at move(model, x, d) as one by d."""
    return h @ reset_slopes(d, model.turns) if model.turns else h


def unit(x, turns):
    """The state x with quaternions of length 1."""
    return normalised(x, turns) if turns else x


def rows_in_tangent(a, y, turns):
    """A matrix of changes of the state y, (n, k), as one of its tangent, (t, k)."""
    return slopes_of_tangent(y, turns) @ a if turns else a


def columns_in_tangent(a, x, turns):
    """A Jacobian by the stored numbers of x, (k, n), as one by its tangent, (k, t)."""
    return a @ slopes_of_stored(x, turns) if turns else a


@operation(same)
def moved(x, d, turns):
    """`move`, if there are rotations."""
    return _computed(steps.move, turns, x, d)


@operation(lambda x, y, turns: (x[0] - len(turns),))
def apart(x, y, turns):
    """`difference`, if there are rotations."""
    return _computed(steps.difference, turns, x, y)


@operation(same)
def normalised(x, turns):
    """`unit`, if there are rotations."""
    return _computed(steps.unit, turns, x)


@operation(lambda x, turns: (x[0], x[0] - len(turns)))
def slopes_of_stored(x, turns):
    """The derivative of move(x, d) at d = 0."""
    return _computed(steps.slopes_of_stored, turns, x)


@operation(lambda y, turns: (y[0] - len(turns), y[0]))
def slopes_of_tangent(y, turns):
    """The derivative of difference(x, y) by x at y."""
    return _computed(steps.slopes_of_tangent, turns, y)


@operation(lambda d, turns: (d[0], d[0]))
def reset_slopes(d, turns):
    """G, the derivative of the step between tangents."""
    return _computed(steps.reset_slopes, turns, d)
