"""Parts of a state or a measurement that are no numbers: rotations, directions, poses; the steps between these.

The state x of n stored numbers has a tangent of t = n - (number of such parts): each stores one more number than
its errors have. Errors, and so P, Q and the prior covariance, live there, with a rotation vector [rad] in the
place of each quaternion:

    move(x, d):        q exp(d) for an error of the body, exp(d) q for one of the world; x + d for numbers
    difference(x, y):  the d with move(y, d) = x

A pose has the exponential of its group (`thruster_env.model.poses`), a direction that of the sphere, without sides
(`thruster_env.model.directions`). A filter that linearises uses the tangent's F and H, from Jacobians of the
stored numbers, and after an update by d it turns P, which is about the old estimate, into the tangent at the new
one (the reset): G P G', with G = J_r(d) for an error of the body, J_l(d) for one of the world. With this the
estimates of an extended filter do not depend on the side.

A measurement z = move(h(x), e), e ~ N(0, R), has its own parts: innovations, S and R live in their tangent.

Source: Hertzberg, Wagner, Frese, Schroeder (2013), "Integrating generic sensor fusion algorithms with sound state
representations through encapsulation of manifolds", Information Fusion 14(1); on the reset: Mueller, Hehn,
D'Andrea (2017), "Covariance correction step for Kalman filtering with an attitude", J. Guidance, Control, and
Dynamics 40(9).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from thruster_env.core import angles
from thruster_env.core.checks import short_repr
from thruster_env.core.equal_functions import makes_functions
from thruster_env.model import directions, poses, rotations
from thruster_env.model.quantities import Quantity

SIDES = "body", "world"
STORED, AXES = "wxyz", "xyz"
MEAN_STEPS = 8  # towards a mean rotation
Quantities = list[Quantity]


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

    @property
    def quantities(self) -> Quantities:
        """The stored numbers."""
        return [Quantity(f"{self.name} {axis}", f"{self.symbol}_{axis}") for axis in STORED]


class Direction(NamedTuple):
    """A direction among the states of a model: a unit vector, with the steps of `directions`.

    Attributes:
        name: in words, such as "magnetic field".
        symbol: of the stored numbers u_x, u_y, u_z and of the errors u_1, u_2 [rad].
    """

    name: str
    symbol: str = "u"
    side: str = "body"  # without a meaning here

    @property
    def quantities(self) -> Quantities:
        """The stored numbers."""
        return [Quantity(f"{self.name} {axis}", f"{self.symbol}_{axis}") for axis in AXES]


class Pose(NamedTuple):
    """A rotation and a position of the world among the states of a model, as one element of SE(3), of `poses`.

    Stored are q_w ... q_z, p_x, p_y, p_z; errors are (phi [rad], rho [m]).

    Attributes:
        name: in words, such as "pose".
        symbol: of the quaternion.
        side: of the error, as that of a `Rotation`: the pose x is x exp(d) or exp(d) x.
        position: symbol of the position.
    """

    name: str
    symbol: str = "q"
    side: str = "body"
    position: str = "p"

    @property
    def quantities(self) -> Quantities:
        """The stored numbers."""
        return Rotation(*self[:3]).quantities + _vector(f"{self.name} position", self.position, "m")


class ExtendedPose(NamedTuple):
    """A rotation, a velocity and a position among the states of a model, as one element of SE_2(3), of `poses`.

    Stored are q_w ... q_z, v_x, v_y, v_z, p_x, p_y, p_z; errors are (phi [rad], nu [m/s], rho [m]). With errors of
    the world and `poses.strapdown` the extended filter of such a state is the invariant one.

    Attributes:
        name: in words, such as "navigation".
        symbol: of the quaternion.
        side: of the error, as that of a `Rotation`: the pose x is x exp(d) or exp(d) x.
        velocity, position: symbols of the vectors of the world.
    """

    name: str
    symbol: str = "q"
    side: str = "body"
    velocity: str = "v"
    position: str = "p"

    @property
    def quantities(self) -> Quantities:
        """The stored numbers."""
        velocity = _vector(f"{self.name} velocity", self.velocity, "m/s")
        position = _vector(f"{self.name} position", self.position, "m")
        return Rotation(*self[:3]).quantities + velocity + position


def _vector(name: str, symbol: str, unit_: str) -> Quantities:
    return [Quantity(f"{name} {axis}", f"{symbol}_{axis}", unit_) for axis in AXES]


PARTS = {Rotation: "rotation", Direction: "direction", Pose: "pose", ExtendedPose: "extended pose"}


class Turn(NamedTuple):
    """A part of a state or a measurement that is no number: where it and its error begin, and what it is."""

    stored: int
    tangent: int
    side: str
    name: str
    kind: str
    size: int  # of the error; one more number is stored

    @property
    def quaternion(self) -> slice:
        """The unit vector of the stored numbers: a quaternion or a direction."""
        return slice(self.stored, self.stored + (3 if self.kind == "direction" else 4))

    def of_state(self, x: Any) -> tuple:
        """The part's numbers of a state."""
        return tuple(x[self.stored : self.stored + self.size + 1])

    def of_tangent(self, d: Any) -> tuple:
        """The part's numbers of an error."""
        return tuple(d[self.tangent : self.tangent + self.size])


def with_rotations(states: Any, known: Sequence[Turn] = ()) -> tuple[Any, tuple[Turn, ...]]:
    """States with a quantity for each stored number, and the parts among them; `known` if states have none.

    Raises:
        ValueError: if a side is unknown.
    """
    if not isinstance(states, Sequence) or not any(type(state) in PARTS for state in states):
        return states, tuple(known)
    quantities: list[Any] = []
    turns: list[Turn] = []
    for state in states:
        if type(state) in PARTS:
            if state.side not in SIDES:
                raise ValueError(
                    f"side of {state.name!r} must be 'body' or 'world', but got {short_repr(state.side)}"
                )
            stored, at = state.quantities, len(quantities)
            kind, size = PARTS[type(state)], len(stored) - 1
            turns.append(Turn(at, at - len(turns), state.side, state.name, kind, size))
            quantities += stored
        else:
            quantities.append(state)
    return quantities, tuple(turns)


def unit_mean(mean: np.ndarray, turns: Sequence[Turn]) -> np.ndarray:
    """A mean (n,) whose quaternions and directions have length 1 to rounding; ValueError if not to 1e-6."""
    mean = mean.copy()
    for turn in turns:
        q = mean[turn.quaternion]
        if not abs(np.linalg.norm(q) - 1.0) < 1e-6:
            what = "(x, y, z)" if turn.kind == "direction" else "a quaternion (w, x, y, z)"
            begins = "begin with " if turn.size > 3 else "be "
            raise ValueError(f"{turn.name!r} must {begins}{what} of length 1, but got {short_repr(q)}")
        q /= np.linalg.norm(q)
    return mean


def refuse_rotations(model: Any) -> None:
    """Raise ValueError for a model whose state or measurement has rotations, directions or poses."""
    turns = *model.turns, *model.measured_turns
    if turns:
        names = " and ".join(dict.fromkeys(repr(turn.name) for turn in turns))
        kinds = " and ".join(dict.fromkeys(f"{turn.kind}s" for turn in turns))
        what = " and ".join(["states"] * bool(model.turns) + ["measurements"] * bool(model.measured_turns))
        raise ValueError(
            f"{what} must be numbers and angles here, but {names} {'is' if len(turns) == 1 else 'are'} of "
            f"{kinds}: filters.run, sessions, C, EstimateState and problems take these for 'ekf', 'iekf', 'ukf', "
            "'ckf', their kin, 'enkf', 'pf' and 'imm'"
        )


def readings(z: np.ndarray, turns: Sequence[Turn]) -> np.ndarray:
    """Measurements (..., m) by innovation: of a part all numbers but the first, NaN where one is missing."""
    z = np.array(z, dtype=np.float64)
    for turn in turns:
        z[..., turn.stored : turn.stored + turn.size + 1][np.isnan(turn.of_state(z.T)).any(axis=0).T] = np.nan
    return np.delete(z, [turn.stored for turn in turns], axis=-1)


def refuse_signs(observe: Callable[[np.ndarray], Any], model: Any) -> None:
    """Raise ValueError if h(x) differs between q and -q of a rotation: no filter knows which one a sensor has.

    Of rotations among the measurements q and -q are equal.
    """
    mean, turns, measured = model.prior_mean, model.turns, model.measured_turns
    x = np.array(move(mean, np.linspace(0.2, 0.4, len(mean) - len(turns)), turns))
    for turn in turns:
        if turn.kind == "direction":
            continue
        other = x.copy()
        other[turn.quaternion] *= -1.0
        try:
            with np.errstate(all="ignore"):
                first, second = (np.asarray(observe(at), dtype=np.float64) for at in (x, other))
        except (ArithmeticError, ValueError):  # not defined there
            continue
        for part in measured:
            if part.kind != "direction" and first[part.quaternion] @ second[part.quaternion] < 0.0:
                second[part.quaternion] *= -1.0
        near = 1e-9 * float(np.nanmax(abs(first), initial=1.0))
        if not np.allclose(first, second, rtol=1e-6, atol=near, equal_nan=True):
            raise ValueError(
                f"observe must be the same for q and -q of {turn.name!r}, which are one attitude, but returned "
                f"{short_repr(first)} and {short_repr(second)}: make a quaternion a Rotation of `measurements`"
            )


def stored_of(values: Sequence, turns: Sequence[Turn], of_rotation: float) -> list:
    """The values of a tangent for each stored number: those of numbers, and another one for unit vectors."""
    result = list(values)
    for turn in turns:
        unit_numbers = 3 if turn.kind == "direction" else 4
        result[turn.stored : turn.stored + unit_numbers - 1] = [of_rotation] * unit_numbers
    return result


def error_quantities(states: Sequence[Quantity], turns: Sequence[Turn]) -> list[Quantity]:
    """The quantities of an error of the state: q_1, q_2, q_3 [rad] of a rotation q_w, q_x, q_y, q_z."""
    result = list(states)
    for turn in reversed(turns):
        symbol, parts = states[turn.stored].symbol.rpartition("_")[0], turn.of_state(states)[1:]
        units = [part.unit or "rad" for part in parts]  # positions follow the quaternion, and their errors
        errors = [Quantity(f"{turn.name} error {i}", f"{symbol}_{i}", unit) for i, unit in enumerate(units, 1)]
        result[turn.stored : turn.stored + turn.size + 1] = errors
    return result


def stored_covs(means: np.ndarray, covs: np.ndarray, turns: Sequence[Turn]) -> np.ndarray:
    """Covariances B P B' (..., n, n) of the stored numbers, of P (..., t, t) and `slopes_of_stored` B at means."""
    if not turns:
        return covs
    slopes, components = np.zeros((*means.shape, covs.shape[-1])), list(np.moveaxis(means, -1, 0))
    for i, row in enumerate(slopes_of_stored(components, turns)):
        for j, entry in enumerate(row):
            slopes[..., i, j] = entry
    return slopes @ covs @ np.swapaxes(slopes, -1, -2)


def leading(turns: Sequence[Turn], known: int) -> tuple[Turn, ...]:
    """The parts among the first `known` stored numbers of a state; ValueError if these end within a part."""
    first = tuple(turn for turn in turns if turn.stored < known)
    if first and first[-1].stored + first[-1].size + 1 > known:
        raise ValueError(f"{first[-1].name!r} must be known with all its numbers, but {known} states are known")
    return first


def tangent_of(model: Any, known: int | None = None) -> tuple[Quantity, ...]:
    """The quantities of an error of a model's state, or of its first `known` stored numbers."""
    states = model.states[:known]
    return tuple(error_quantities(states, leading(model.turns, len(states))))


def innovations_of(model: Any) -> tuple[Quantity, ...]:
    """The m quantities of an innovation of a model, of R and of an error of a measurement."""
    return tuple(error_quantities(model.measurements, model.measured_turns))


def differences_of(model: Any, measured: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """Differences (..., m) of measurements z from y (..., channels): z - y, angles wrapped, e of rotations.

    z = move(y, e), NaN where a number of the part is missing
    """
    turns, flags = model.measured_turns, model.any_shape.measurement_angles
    if not turns:
        return angles.difference(measured, expected, flags)
    z, y = (np.moveaxis(values, -1, 0) for values in np.broadcast_arrays(measured, expected))
    e = np.stack([np.asarray(part) for part in innovation(z, y, turns)], axis=-1)
    return angles.wrapped_where(e, tangent_flags(flags, turns))


def about_mean(rows: np.ndarray, turns: Sequence[Turn], flags: Sequence[bool]) -> np.ndarray:
    """States or measurements, one a row, angles on the branch of their circular mean; NaN where one is missing.

    With rotations among them these are differences (N, t) from the mean row.
    """
    if not turns:
        return angles.on_one_branch(rows, flags)
    complete = ~np.isnan(rows).any(axis=1)
    mean = rows[complete.argmax()]
    for _ in range(MEAN_STEPS):
        apart = np.stack([np.asarray(d) for d in innovation(rows.T, mean[:, None], turns)], axis=-1)
        apart = angles.wrapped_where(apart, tangent_flags(flags, turns))
        mean = np.array(move(mean, np.nanmean(apart, axis=0), turns))
    return apart


def errors_of(model: Any, means: np.ndarray, states: np.ndarray) -> np.ndarray:
    """Errors (..., t) of means (..., n) in their tangent: means - states, angles wrapped, and e of rotations.

        states = move(means, -e), so that P at the means is the covariance of e

    Args:
        model: the `StateSpaceModel` of the means.
        means: of all its states.
        states: the true ones (..., k), the first k of these.
    """
    known = states.shape[-1]
    means, turns = means[..., :known], leading(model.turns, known)
    if not turns:
        return angles.difference(means, states, model.any_shape.state_angles[:known])
    x, y = (np.moveaxis(values, -1, 0) for values in np.broadcast_arrays(states, means))
    errors = -np.stack([np.asarray(part) for part in difference(x, y, turns)], axis=-1)
    return angles.wrapped_where(errors, [quantity.angle for quantity in tangent_of(model, known)])


# The steps, on sequences of components: floats, arrays of them, or numbers that are traced.


def move(x: Any, d: Any, turns: Sequence[Turn]) -> list:
    """The state x (n) moved by d (t) of its tangent."""
    result: list[Any] = []
    for turn, i, j in parts_of(len(x), turns):
        if turn is None:
            result.append(x[i] + d[j])
        elif turn.kind == "direction":
            result += directions.move(turn.of_state(x), turn.of_tangent(d))
        else:
            part, by = turn.of_state(x), poses.exponential(turn.of_tangent(d))
            result += _unit(turn, poses.product(*((part, by) if turn.side == "body" else (by, part))))
    return result


def difference(x: Any, y: Any, turns: Sequence[Turn]) -> list:
    """The d (t) of the tangent at y with move(y, d) = x, of states x and y (n)."""
    result: list[Any] = []
    for turn, i, _ in parts_of(len(x), turns):
        if turn is None:
            result.append(x[i] - y[i])
        elif turn.kind == "direction":
            result += directions.difference(turn.of_state(x), turn.of_state(y))
        else:
            part, back = turn.of_state(x), poses.inverse(turn.of_state(y))
            between = (back, part) if turn.side == "body" else (part, back)
            result += poses.logarithm(poses.product(*between))
    return result


def unit(x: Any, turns: Sequence[Turn]) -> list:
    """The state x (n) with quaternions and directions of length 1."""
    result: list[Any] = []
    for turn, i, _ in parts_of(len(x), turns):
        result += [x[i]] if turn is None else _unit(turn, turn.of_state(x))
    return result


def innovation(z: Any, y: Any, turns: Sequence[Turn]) -> list:
    """The d (t) with move(y, d) = z of measurements; NaN in parts of z with a missing number.

    It is infinite where a part of z has no difference from y, as opposite directions have none, or y is NaN: no
    filter is to take such a part for a missing one.
    """
    d, result = difference(unit(z, turns), y, turns), []
    for turn, i, j in parts_of(len(z), turns):
        known = _known(z, turn, i)
        for component in d[j : j + (1 if turn is None else turn.size)]:
            result.append(np.where(known, np.where(component == component, component, np.inf), np.nan))
    return result


def completed(z: Any, y: Any, turns: Sequence[Turn]) -> list:
    """The measurement z with the numbers of y in each part that misses one."""
    result: list[Any] = []
    for turn, i, _ in parts_of(len(z), turns):
        part = slice(i, i + (1 if turn is None else turn.size + 1))
        known, parts = _known(z, turn, i), zip(unit(z, turns)[part], y[part], strict=True)
        result += [np.where(known, measured, other) for measured, other in parts]
    return result


def _known(z: Any, turn: Turn | None, i: int) -> Any:
    """Whether no number of a part of a measurement is NaN."""
    known = z[i] == z[i]
    for entry in () if turn is None else turn.of_state(z)[1:]:
        known = known & (entry == entry)
    return known


def tangent_flags(angles: Sequence[bool], turns: Sequence[Turn]) -> tuple[bool, ...]:
    """Which numbers of a tangent are angles, of those of stored numbers."""
    firsts = {turn.stored for turn in turns}
    return tuple(angle for i, angle in enumerate(angles) if i not in firsts)


def of_channels(flags: Sequence, turns: Sequence[Turn]) -> list:
    """Flags of numbers of a tangent for each stored number: those of a part are true if one of them is."""
    result = list(flags)
    for turn in turns:
        result[turn.stored : turn.stored + turn.size] = [any(turn.of_tangent(flags))] * (turn.size + 1)
    return result


def _unit(turn: Turn, part: tuple) -> tuple:
    return directions.unit(part) if turn.kind == "direction" else (*rotations.normalised(part[:4]), *part[4:])


def parts_of(n: int, turns: Sequence[Turn]) -> list[tuple[Turn | None, int, int]]:
    """The parts of a state in their order, None for numbers, with offsets among the stored and in the tangent."""
    by_offset, result, i, j = {turn.stored: turn for turn in turns}, [], 0, 0
    while i < n:
        turn = by_offset.get(i)
        result.append((turn, i, j))
        i, j = (i + 1, j + 1) if turn is None else (i + turn.size + 1, j + turn.size)
    return result


def slopes_of_stored(x: Any, turns: Sequence[Turn]) -> list[list]:
    """The derivative of move(x, d) at d = 0, (n, t): of a rotation q (0, e_i)/2 or (0, e_i) q/2."""
    return _byparts_of(len(x), turns, (1, 0), lambda turn: _stored_slopes(turn, turn.of_state(x)))


def _stored_slopes(turn: Turn, x: tuple) -> list[list]:
    if turn.kind == "direction":
        return [list(row) for row in directions.basis(x)]
    columns = _quaternion_slopes(x[:4], turn.side)
    result = _blocks(4, 3, [[0.5 * column[i] for column in columns] for i in range(4)], turn.size + 1)
    for k, r in enumerate(poses.vectors(x)):
        if turn.side == "body":
            _put(result, 4 + 3 * k, 3 + 3 * k, rotations.matrix(x[:4]))
        else:
            _put(result, 4 + 3 * k, 0, _negative(poses.skew(r)))
    return result


def slopes_of_tangent(y: Any, turns: Sequence[Turn]) -> list[list]:
    """The derivative of difference(x, y) by x at x = y, (t, n); a unit vector of y need not have length 1."""
    return _byparts_of(len(y), turns, (0, 1), lambda turn: _tangent_slopes(turn, turn.of_state(y)))


def _tangent_slopes(turn: Turn, y: tuple) -> list[list]:
    if turn.kind == "direction":
        length, B = directions.length(y), directions.basis(directions.unit(y))
        return [[B[i][j] / length for i in range(3)] for j in range(2)]
    w, a, b, c = y[:4]
    scale = 2.0 / (w * w + a * a + b * b + c * c)
    rows = [[scale * entry for entry in column] for column in _quaternion_slopes(y[:4], turn.side)]
    result = _blocks(3, 4, rows, turn.size)
    back = rotations.matrix(rotations.inverse(rotations.normalised(y[:4]))) if turn.size > 3 else ()
    for k, r in enumerate(poses.vectors(y)):
        if turn.side == "body":
            _put(result, 3 + 3 * k, 4 + 3 * k, back)
        else:
            S = poses.skew(r)
            by_q = [[sum(S[i][m] * rows[m][j] for m in range(3) if m != i) for j in range(4)] for i in range(3)]
            _put(result, 3 + 3 * k, 0, by_q)
    return result


def _quaternion_slopes(q: tuple, side: str) -> list:
    units = [tuple(float(k == i) for k in range(4)) for i in (1, 2, 3)]
    return [rotations.product(*((q, e) if side == "body" else (e, q))) for e in units]


def _blocks(first_rows: int, first_columns: int, first: Any, rows: int) -> list[list]:
    """A matrix of a pose with a first block, and the identity of its vectors."""
    columns = rows - first_rows + first_columns
    result = [[float(i - first_rows == j - first_columns >= 0) for j in range(columns)] for i in range(rows)]
    _put(result, 0, 0, first)
    return result


def _put(matrix: list[list], row: int, column: int, block: Any) -> None:
    for i, entries in enumerate(block):
        matrix[row + i][column : column + len(entries)] = entries


def _negative(rows: Any) -> list[list]:
    return [[-x for x in row] for row in rows]


def _byparts_of(n: int, turns: Sequence[Turn], more: tuple[int, int], of_turn: Callable) -> list[list]:
    """A matrix with 1 for numbers and a block for each turn; sides with `more` are as long as the stored state."""
    sides = [n if stored else n - len(turns) for stored in more]
    result = [[0.0] * sides[1] for _ in range(sides[0])]
    for turn, i, j in parts_of(n, turns):
        _put(result, i if more[0] else j, i if more[1] else j, [[1.0]] if turn is None else of_turn(turn))
    return result


def reset_slopes(x: Any, d: Any, turns: Sequence[Turn]) -> list[list]:
    """G = d difference(move(x, d + e), move(x, d))/de at e = 0, (t, t): J_r(d) or J_l(d), 1 for numbers."""
    return _byparts_of(len(x), turns, (0, 0), lambda turn: _reset(turn, x, d, poses.left_jacobian))


def inverse_reset_slopes(x: Any, d: Any, turns: Sequence[Turn]) -> list[list]:
    """The inverse of `reset_slopes`, (t, t)."""
    return _byparts_of(len(x), turns, (0, 0), lambda turn: _reset(turn, x, d, poses.inverse_left_jacobian))


def _reset(turn: Turn, x: Any, d: Any, jacobian: Callable) -> list[list]:
    part = turn.of_tangent(d)
    if turn.kind == "direction":
        G = directions.reset(turn.of_state(x), part)
        return G if jacobian is poses.left_jacobian else directions.inverse(G)
    return jacobian([-k for k in part] if turn.side == "body" else part)


# Rates of a state with rotations: of its tangent, the angular rate [rad/s] in the axes of the error's side.


@makes_functions
def runge_kutta_munthe_kaas(rates: Callable, turns: tuple[Turn, ...]) -> Callable:
    """Return `step(x, u, c)`, one step of order four of length c.substep [s], exact for constant rates.

        x(t) = move(x_0, d(t)),  d' = J^-1(d) rates(x, u, c),  J^-1 = I + [d]x/2 + [d]x^2/12 of the body (-[d]x/2
        of the world),  d_0 = 0

    by Runge and Kutta's classical method; the further terms of J^-1 are of higher order. Of a pose [d]x e is the
    bracket [d, e] (`thruster_env.model.poses`).

    Args:
        rates: `rates(x, u, c)`, the t rates of the tangent of the n stored numbers x.
        turns: rotations and poses of the state, one or more.

    Source: Munthe-Kaas (1999), "High order Runge-Kutta methods on manifolds", Applied Numerical Mathematics 29(1).
    """

    def slope(x: Any, d: list, u: Any, c: Any) -> list:
        result = list(rates(tuple(move(x, d, turns)), u, c))
        for turn in turns:
            part = slice(turn.tangent, turn.tangent + turn.size)
            side = 0.5 if turn.side == "body" else -0.5
            once = poses.bracket(d[part], result[part])
            twice = poses.bracket(d[part], once)
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


def slope_of_rates(slopes: np.ndarray, rates: Sequence[float], turns: Sequence[Turn]) -> np.ndarray:
    """A (t, t) of d' = A d, the error's rate, from the derivative of the rates by d and the rates themselves.

    The error of a rotation is in axes that turn: -[omega]x d is added for one of the body, [omega]x d for the
    world.
    """
    result = np.array(slopes)
    for turn in turns:
        part = slice(turn.tangent, turn.tangent + turn.size)
        columns = [poses.bracket(rates[part], unit_) for unit_ in np.eye(turn.size)]
        result[part, part] += (-1.0 if turn.side == "body" else 1.0) * np.transpose(columns)
    return result
