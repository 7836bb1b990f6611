"""Rotations in the state of a model: four stored numbers, three of error, and the steps between them.

The state x of n stored numbers has a tangent of t = n - (number of rotations). Errors, and so P, Q and the prior
covariance, live there, with a rotation vector [rad] in the place of each quaternion:

    move(x, d):        q exp(d) for an error of the body, exp(d) q for one of the world; x + d for numbers
    difference(x, y):  the d with move(y, d) = x

A filter that linearises uses the tangent's F and H, from Jacobians of the stored numbers, and after an update by d
it turns P, which is about the old estimate, into the tangent at the new one (the reset): G P G', with
G = J_r(d) for an error of the body, J_l(d) for one of the world. With this the estimates of an extended filter do
not depend on the side.

Source: Hertzberg, Wagner, Frese, Schroeder (2013), "Integrating generic sensor fusion algorithms with sound state
representations through encapsulation of manifolds", Information Fusion 14(1); on the reset: Mueller, Hehn,
D'Andrea (2017), "Covariance correction step for Kalman filtering with an attitude", J. Guidance, Control, and
Dynamics 40(9).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from thruster_env.core.checks import short_repr
from thruster_env.core.equal_functions import makes_functions
from thruster_env.model import rotations
from thruster_env.model.quantities import Quantity

SIDES = "body", "world"
STORED = "wxyz"


class Rotation(NamedTuple):
    """A rotation among the states of a model: a unit quaternion, R(q) body to world, of `rotations`.

    Attributes:
        name: in words, such as "attitude".
        symbol: of the stored numbers q_w, q_x, q_y, q_z and of the errors q_1, q_2, q_3 [rad].
        side: of the error: "body", q exp(d), or "world", exp(d) q; P and Q are in these axes.
    """

    name: str
    symbol: str = "q"
    side: str = "body"


class Turn(NamedTuple):
    """A rotation of a state: offsets of its quaternion and of its error, and the side of the error."""

    stored: int
    tangent: int
    side: str
    name: str


def with_rotations(states: Any, known: Sequence[Turn] = ()) -> tuple[Any, tuple[Turn, ...]]:
    """States with a quantity for each stored number, and the rotations among them; `known` if states have none.

    Raises:
        ValueError: if a side is unknown.
    """
    if not isinstance(states, Sequence) or not any(isinstance(state, Rotation) for state in states):
        return states, tuple(known)
    quantities: list[Any] = []
    turns: list[Turn] = []
    for state in states:
        if isinstance(state, Rotation):
            name, symbol, side = state
            if side not in SIDES:
                raise ValueError(f"side of {name!r} must be 'body' or 'world', but got {short_repr(side)}")
            turns.append(Turn(len(quantities), len(quantities) - len(turns), side, name))
            quantities += [Quantity(f"{name} {axis}", f"{symbol}_{axis}") for axis in STORED]
        else:
            quantities.append(state)
    return quantities, tuple(turns)


def unit_mean(mean: np.ndarray, turns: Sequence[Turn]) -> np.ndarray:
    """A mean (n,) whose quaternions have length 1 to rounding; ValueError if they do not to 1e-6."""
    mean = mean.copy()
    for turn in turns:
        q = mean[turn.stored : turn.stored + 4]
        if not abs(np.linalg.norm(q) - 1.0) < 1e-6:
            raise ValueError(
                f"{turn.name!r} must be a quaternion (w, x, y, z) of length 1, but got {short_repr(q)}"
            )
        q /= np.linalg.norm(q)
    return mean


def refuse_rotations(model: Any) -> None:
    """Raise ValueError for a model whose state has rotations."""
    if model.turns:
        names = " and ".join(repr(turn.name) for turn in model.turns)
        raise ValueError(
            f"states must be numbers and angles here, but {names} {'is' if len(model.turns) == 1 else 'are'} of "
            "rotations: 'ekf', 'iekf', 'ukf' and 'fading' take these, in filters.run, sessions, wrapped envs and C"
        )


def stored_of(values: Sequence, turns: Sequence[Turn], of_rotation: float) -> list:
    """The values of a tangent for each stored number: those of numbers, and another one for quaternions."""
    result = list(values)
    for turn in turns:
        result[turn.stored : turn.stored + 3] = [of_rotation] * 4
    return result


def tangent_of(values: Sequence, turns: Sequence[Turn], of_rotation: Any) -> list:
    """The values of stored numbers for each component of an error, and another one for rotation vectors."""
    result = list(values)
    for turn in reversed(turns):
        result[turn.stored : turn.stored + 4] = [of_rotation] * 3
    return result


# The steps, on sequences of components: floats, arrays of them, or numbers that are traced.


def move(x: Sequence, d: Sequence, turns: Sequence[Turn]) -> list:
    """The state x (n) moved by d (t) of its tangent."""
    return _joined(x, d, turns, lambda a, b: a + b, _turned)


def _turned(q: Any, d: Any, side: str) -> rotations.Quaternion:
    by = rotations.exponential(d)
    return rotations.normalised(rotations.product(q, by) if side == "body" else rotations.product(by, q))


def difference(x: Sequence, y: Sequence, turns: Sequence[Turn]) -> list:
    """The d (t) of the tangent at y with move(y, d) = x, of states x and y (n)."""
    result: list[Any] = []
    k = 0
    by_offset = {turn.stored: turn for turn in turns}
    while k < len(x):
        if k in by_offset:
            p, back = x[k : k + 4], rotations.inverse(y[k : k + 4])
            between = (back, p) if by_offset[k].side == "body" else (p, back)
            result += rotations.logarithm(rotations.product(*between))
            k += 4
        else:
            result.append(x[k] - y[k])
            k += 1
    return result


def unit(x: Sequence, turns: Sequence[Turn]) -> list:
    """The state x (n) with quaternions of length 1."""
    return _joined(x, None, turns, lambda a, b: a, lambda q, d, side: rotations.normalised(q))


def _joined(x: Sequence, d: Any, turns: Sequence[Turn], of_number: Any, of_rotation: Any) -> list:
    result: list[Any] = []
    by_offset, k = {turn.stored: turn for turn in turns}, 0
    while len(result) < len(x):
        at = len(result)
        if at in by_offset:
            part = None if d is None else tuple(d[k : k + 3])
            result += of_rotation(tuple(x[at : at + 4]), part, by_offset[at].side)
            k += 3
        else:
            result.append(of_number(x[at], None if d is None else d[k]))
            k += 1
    return result


def slopes_of_stored(x: Sequence, turns: Sequence[Turn]) -> list[list]:
    """The derivative of move(x, d) at d = 0, (n, t): of a rotation q (0, e_i)/2 or (0, e_i) q/2."""
    n, t = len(x), len(x) - len(turns)
    result = [[0.0] * t for _ in range(n)]
    for i, j in _numbers(n, turns):
        result[i][j] = 1.0
    for turn in turns:
        for j, column in enumerate(_quaternion_slopes(x, turn)):
            for i, entry in enumerate(column):
                result[turn.stored + i][turn.tangent + j] = 0.5 * entry
    return result


def slopes_of_tangent(y: Sequence, turns: Sequence[Turn]) -> list[list]:
    """The derivative of difference(x, y) by x at x = y, (t, n); a quaternion y need not have length 1."""
    n, t = len(y), len(y) - len(turns)
    result = [[0.0] * n for _ in range(t)]
    for i, j in _numbers(n, turns):
        result[j][i] = 1.0
    for turn in turns:
        w, a, b, c = y[turn.stored : turn.stored + 4]
        scale = 2.0 / (w * w + a * a + b * b + c * c)
        for j, column in enumerate(_quaternion_slopes(y, turn)):
            for i, entry in enumerate(column):
                result[turn.tangent + j][turn.stored + i] = scale * entry
    return result


def _quaternion_slopes(x: Sequence, turn: Turn) -> list:
    q = tuple(x[turn.stored : turn.stored + 4])
    units = [tuple(float(k == i) for k in range(4)) for i in (1, 2, 3)]
    return [rotations.product(*((q, e) if turn.side == "body" else (e, q))) for e in units]


def _numbers(n: int, turns: Sequence[Turn]) -> list[tuple[int, int]]:
    """Offsets, stored and of the tangent, of components that are no rotation."""
    of_rotations = {turn.stored + k for turn in turns for k in range(4)}
    return [(i, i - sum(turn.stored < i for turn in turns)) for i in range(n) if i not in of_rotations]


def reset_slopes(d: Sequence, turns: Sequence[Turn]) -> list[list]:
    """G = d difference(move(x, d + e), move(x, d))/de at e = 0, (t, t): J_r(d) or J_l(d), 1 for numbers."""
    return _by_rotation(d, turns, rotations.left_jacobian)


def inverse_reset_slopes(d: Sequence, turns: Sequence[Turn]) -> list[list]:
    """The inverse of `reset_slopes`, (t, t)."""
    return _by_rotation(d, turns, rotations.inverse_left_jacobian)


def _by_rotation(d: Sequence, turns: Sequence[Turn], of_rotation: Any) -> list[list]:
    """The identity with the matrix of d, or of -d for errors of the body, at each rotation."""
    t = len(d)
    result = [[float(i == j) for j in range(t)] for i in range(t)]
    for turn in turns:
        sign = -1.0 if turn.side == "body" else 1.0
        part = [sign * d[turn.tangent + k] for k in range(3)]
        for i, row in enumerate(of_rotation(part)):
            result[turn.tangent + i][turn.tangent : turn.tangent + 3] = row
    return result


# Rates of a state with rotations: of its tangent, the angular rate [rad/s] in the axes of the error's side.


@makes_functions
def runge_kutta_munthe_kaas(rates: Callable, turns: tuple[Turn, ...]) -> Callable:
    """Return `step(x, u, c)`, one step of order four of length c.substep [s], exact for a constant angular rate.

        x(t) = move(x_0, d(t)),  d' = J^-1(d) rates(x, u, c),  J^-1 = I + [d]x/2 + [d]x^2/12 of the body (-[d]x/2
        of the world),  d_0 = 0

    by Runge and Kutta's classical method; the further terms of J^-1 are of higher order.

    Args:
        rates: `rates(x, u, c)`, the t rates of the tangent of the n stored numbers x.
        turns: rotations of the state, one or more.

    Source: Munthe-Kaas (1999), "High order Runge-Kutta methods on manifolds", Applied Numerical Mathematics 29(1).
    """

    def slope(x: Any, d: list, u: Any, c: Any) -> list:
        result = list(rates(tuple(move(x, d, turns)), u, c))
        for turn in turns:
            part = slice(turn.tangent, turn.tangent + 3)
            side = 0.5 if turn.side == "body" else -0.5
            once = _cross(d[part], result[part])
            twice = _cross(d[part], once)
            result[part] = [v + side * a + b / 12.0 for v, a, b in zip(result[part], once, twice, strict=True)]
        return result

    def step(x, u, c):
        h = c.substep
        k1 = list(rates(x, u, c))
        k2 = slope(x, [0.5 * h * k for k in k1], u, c)
        k3 = slope(x, [0.5 * h * k for k in k2], u, c)
        k4 = slope(x, [h * k for k in k3], u, c)
        parts = zip(k1, k2, k3, k4, strict=True)
        return tuple(move(x, [h / 6.0 * (a + 2.0 * (b + c) + d) for a, b, c, d in parts], turns))

    return step


def _cross(a: Sequence, b: Sequence) -> list:
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def slope_of_rates(slopes: np.ndarray, rates: Sequence[float], turns: Sequence[Turn]) -> np.ndarray:
    """A (t, t) of d' = A d, the error's rate, from the derivative of the rates by d and the rates themselves.

    The error of a rotation is in axes that turn: -[omega]x d is added for one of the body, [omega]x d for the
    world.
    """
    result = np.array(slopes)
    for turn in turns:
        part = slice(turn.tangent, turn.tangent + 3)
        skew = np.cross(np.eye(3), rates[part])
        result[part, part] += -skew if turn.side == "body" else skew
    return result
