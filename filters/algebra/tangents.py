"""Operations of pages on states with rotations: the steps of `thruster_env.model.turns`, on matrices.

Of a model without rotations each is the plain operation: a sum, or nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from functools import cache
from typing import Any

import numpy as np

from filters.algebra.matrices import Operation, never, operation, same
from filters.algebra.operations import sym, wrap
from filters.algebra.points import ones, outer
from filters.algebra.roots import zeros
from thruster_env.graphs.graphs import Graph, Number
from thruster_env.graphs.tracing import traced
from thruster_env.model import turns as steps
from thruster_env.model.traced import slopes_along

_traced = cache(traced)


def _computed(function: Callable, turns: Any, *vectors: Any) -> np.ndarray:
    """A function of sequences of components, and of the rotations, for arrays of floats or of Numbers."""
    if all(vector.dtype != object for vector in vectors):
        return np.array(function(*vectors, turns))
    for number in np.concatenate([vector.ravel() for vector in vectors]):
        if isinstance(number, Number):
            number.graph.whole.add(number.place)  # its own operations may be rounded as they like
    points = [vector.shape[1] for vector in vectors if vector.ndim == 2]
    if points:
        columns = [[v[:, j] if v.ndim == 2 else v for v in vectors] for j in range(points[0])]
        return np.array([_traced(function)(*map(list, column), turns) for column in columns], dtype=object).T
    return np.array(_traced(function)(*map(list, vectors), turns), dtype=object)


def _differentiable(of: Operation, function: Callable) -> None:
    """Give an operation its derivative: that of the graph of its function, along changes of all vectors."""

    def slope(*arguments: Any) -> np.ndarray:
        *parts, turns = arguments
        count = len(parts) // 2
        pairs = [
            (number, 0.0 if change is None else change.ravel()[i])
            for vector, change in zip(parts[:count], parts[count:], strict=True)
            for i, number in enumerate(vector.ravel())
            if isinstance(number, Number)  # others are constants
        ]
        value = _computed(function, turns, *parts[:count])
        numbers, changes = (np.array(part, dtype=object) for part in zip(*pairs, strict=True))
        return slopes_along(value, (numbers, changes))

    def shape(*shapes: Any) -> tuple[int, ...]:
        return of.shape(*shapes[: len(shapes) // 2], shapes[-1])

    along = Operation(slope, shape, never)
    along.name = f"slope_of_{of.name}"
    of.derivative(lambda result, arguments, slopes: along(*arguments[:-1], *slopes[:-1], arguments[-1]))


def move(model, x, d):
    """The state x moved by d of its tangent: x + d with wrapped angles, q exp(d) or exp(d) q of a rotation."""
    return wrap(moved(x, d, model.turns) if model.turns else x + d, model.state_angles)


def added(model, x, d):
    """`move` of a member without wrapped angles: x + d, q exp(d) or exp(d) q of a rotation."""
    return moved(x, d, model.turns) if model.turns else x + d


def points_around(model, x, D):
    """The points move(model, x, d) of each column d of D, (n, points), angles not wrapped."""
    return moved(x, D, model.turns) if model.turns else outer(x, ones(D)) + D


def differences(model, Y, y):
    """The d with move(model, y, d) = Y of a state, or of each column of Y, (t, points): Y - y, angles wrapped."""
    angles = steps.tangent_flags(model.state_angles, model.turns)
    if model.turns:
        return wrap(apart(Y, y, model.turns), angles)
    return wrap(Y - y if len(Y.shape) == 1 else Y - outer(y, ones(Y)), angles)


def reset(model, p, x, d):
    """G P G': a covariance about x in the tangent at move(model, x, d); see `thruster_env.model.turns`."""
    if not model.turns:
        return p
    G = reset_slopes(x, d, model.turns)
    return sym(G @ p @ G.T)


def after_reset(model, D, x, d):
    """G D: errors about x, the columns of D or a vector, in the tangent at move(model, x, d)."""
    return reset_slopes(x, d, model.turns) @ D if model.turns else D


def reset_back(model, p, x, d):
    """G^-1 P G^-1': a covariance about move(model, x, d) in the tangent at x."""
    if not model.turns:
        return p
    J = inverse_reset_slopes(x, d, model.turns)
    return sym(J @ p @ J.T)


def reset_columns(model, h, x, d):
    """H G: a Jacobian by the tangent at move(model, x, d) as one by d."""
    return h @ reset_slopes(x, d, model.turns) if model.turns else h


def unit(x, turns):
    """The state x with quaternions and directions of length 1."""
    return normalised(x, turns) if turns else x


def local_at(model, z, x):
    """The model and the measurement z in the tangent at h(x), of `about`; without rotations there as they are."""
    return about(model, z, model.h(x)) if model.measured_turns else (model, z)


def local_at_measurement(model, z, x):
    """The same in the tangent at z, or at h(x) in parts of z that miss a number."""
    turns = model.measured_turns
    return about(model, z, completed(z, unit(model.h(x), turns), turns)) if turns else (model, z)


def about(model, z, y):
    """The model and the measurement z in the tangent of measurements at y.

        z becomes difference(z, y),  h(x) difference(h(x), y),  H the derivative of that

    so that a page's innovation z - h(x) and its S have the components of R. At y = h(x) of the mean they are those
    of the extended filter. At y = z, if z is a rotation or a pose, z = move(h(x), e) is exactly h(x) + e = 0 for
    these, and H that of Gauss and Newton's method (`at_measurement` of the model that is returned).
    """
    turns = model.measured_turns
    local, centre = copy(model), unit(y, turns)
    local.measured_turns, local.measurement_angles = (), steps.tangent_flags(model.measurement_angles, turns)

    def h(x):
        at_x = model.h(x)
        return zeros(model.R, len(model.R)) if at_x is y else apart(unit(at_x, turns), centre, turns)

    def H(x):  # noqa: N802
        at_x = model.h(x)
        slopes = slopes_of_tangent(at_x, turns) @ model.H(x)
        return slopes if at_x is y else inverse_reset_slopes(centre, h(x), turns) @ slopes

    local.h, local.H = h, H
    local.at_measurement = lambda _: about(model, z, completed(z, centre, turns))
    return local, innovation(z, centre, turns)


def rows_in_tangent(a, y, turns):
    """A matrix of changes of the state y, (n, k), as one of its tangent, (t, k)."""
    return slopes_of_tangent(y, turns) @ a if turns else a


def columns_in_tangent(a, x, turns):
    """A Jacobian by the stored numbers of x, (k, n), as one by its tangent, (k, t)."""
    return a @ slopes_of_stored(x, turns) if turns else a


@operation(lambda x, d, turns: (x[0], *d[1:]))
def moved(x, d, turns):
    """`move` and `points_around`, if there are rotations."""
    return _computed(steps.move, turns, x, d)


@operation(lambda z, y, turns: (z[0] - len(turns),))
def innovation(z, y, turns):
    """The difference of a measurement from y, of `thruster_env.model.turns`."""
    return _computed(steps.innovation, turns, z, y)


@operation(same)
def completed(z, y, turns):
    """A measurement with numbers of y in parts that miss one."""
    return _computed(steps.completed, turns, z, y)


@operation(lambda x, y, turns: (x[0] - len(turns), *x[1:]))
def apart(x, y, turns):
    """`differences`, if there are rotations."""
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


@operation(lambda x, d, turns: (d[0], d[0]))
def inverse_reset_slopes(x, d, turns):
    """The inverse of G."""
    return _computed(steps.inverse_reset_slopes, turns, x, d)


@operation(lambda x, d, turns: (d[0], d[0]))
def reset_slopes(x, d, turns):
    """G, the derivative of the step between tangents."""
    return _computed(steps.reset_slopes, turns, x, d)


OF_COMPONENTS: dict[Operation, Callable] = {
    moved: steps.move,
    apart: steps.difference,
    innovation: steps.innovation,
    completed: steps.completed,
    normalised: steps.unit,
    slopes_of_stored: steps.slopes_of_stored,
    slopes_of_tangent: steps.slopes_of_tangent,
    reset_slopes: steps.reset_slopes,
    inverse_reset_slopes: steps.inverse_reset_slopes,
}
"""The functions of sequences of components, and of the rotations, that compute the operations."""
for _operation, _function in OF_COMPONENTS.items():
    _differentiable(_operation, _function)


@cache
def numbers_of(of: Operation, sizes: tuple[int, ...], turns: Any) -> np.ndarray:
    """The result of an operation as Numbers of a graph, whose given ones are (argument, component)."""
    graph = Graph()
    vectors = [[graph.given((part, k)) for k in range(size)] for part, size in enumerate(sizes)]
    result = np.array(_traced(OF_COMPONENTS[of])(*vectors, turns), dtype=object)
    return np.array([graph.number(entry) for entry in result.ravel()], dtype=object).reshape(result.shape)
