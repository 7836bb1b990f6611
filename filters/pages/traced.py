"""A model's functions, traced: graphs of numbers, and derivatives of these."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from functools import lru_cache

import numpy as np

from thruster_env.core.derivatives import by_complex_step
from thruster_env.core.sources import is_array
from thruster_env.graphs.branches import along, on_every_side
from thruster_env.graphs.graphs import Graph, Number
from thruster_env.graphs.programs import Place, values_of
from thruster_env.graphs.tracing import traced
from thruster_env.model.shape import Functions, Shape, constants_are_array

MOST = 30_000  # operations of a stage: beyond, instructions take longer to compile than calls
POINTS = ((0.1, 0.5), (1.0, 1.0), (1.0, 2.5), (10.0, 4.0))  # magnitudes and phases, where graphs are compared


@lru_cache(maxsize=64)
def traced_model(functions: Functions, shape: Shape, partly: bool = False) -> tuple[Traced | Untraced, ...]:
    """A model's f and h, traced once for all filters; where one cannot be, TypeError or, `partly`, a stand-in."""
    f, by_f, h, by_h = functions
    make: Callable = traced_if_possible if partly else Traced
    return make(f, by_f, 2, shape), make(h, by_h, 1, shape)


class Traced:
    """A function of a model, traced: of arrays of Numbers it is what it does, and so are its derivatives.

    Attributes:
        parts: it, its Jacobian, and the slopes of both, as operations of `Equations` take them.
        of_points: it and its slope, of each column of a matrix.
    """

    def __init__(self, function: Callable, jacobian: Callable | None, others: int, shape: Shape):
        """Take the function of x and others, and its Jacobian as the model gives it, or None."""
        self._function, self._others, self._shape = traced(function), others, shape
        self._jacobian = None if jacobian is None or by_complex_step(jacobian) else traced(jacobian)
        self.parts = self._value, self._matrix, self._by_constants, self._slope
        self.of_points = self._values_of_points, self._slopes_of_points
        self._check(function, jacobian)

    def _check(self, *functions: Callable | None) -> None:
        """Raise TypeError unless the graph has the functions' values, wherever these are finite.

        A function that asks what kind of a number it got may have done something else with ours.
        """
        graph, shape = Graph(MOST), self._shape
        sizes = (shape.n, shape.inputs, shape.constants) if self._others == 2 else (shape.n, shape.constants)
        ends, agreed = np.cumsum(sizes), False
        x, *others = np.split(np.array([graph.given(Place("numbers", k)) for k in range(ends[-1])]), ends[:-1])
        graphs = [self._value(x, *others)]
        if self._jacobian is not None:
            graphs.append(self._matrix(x, None, *others))
        numbers = [graph.number(one) for part in graphs for one in part.ravel()]
        points = np.array([magnitude * np.sin(phase + np.arange(ends[-1])) for magnitude, phase in POINTS])
        points[:, ends[-2] :] = 0.1 + abs(points[:, ends[-2] :])  # constants
        with np.errstate(all="ignore"):
            all_found = values_of(numbers, points.T).T
        for point, found in zip(points, all_found, strict=True):
            expected = _values_at(self._given(*np.split(point, ends[:-1])), functions[: len(graphs)])
            if np.isfinite(expected).all():
                agreed = np.allclose(found, expected, rtol=1e-9, atol=1e-9 * abs(expected).max(initial=0.0))
                if not agreed:
                    raise TypeError("a function does something else with numbers that are not known yet")
        if not agreed:
            raise TypeError("a function has no value at any point where its graph could be compared with it")

    def _given(self, x, *others) -> list:
        """Arguments in the form in which the model takes them, components as Python's floats.

        NumPy's booleans add up to one: of its floats (x > 0) + (y > 0) were 1 where Python and machine code say 2.
        """
        *u, c = others
        for one in (*x, *c):  # along which slopes are taken
            if isinstance(one, Number):
                one.graph.whole.add(one.place)
        plain = [one if is_array(len(one)) else tuple(one.tolist()) for one in (x, *u)]
        form = self._shape.form
        if constants_are_array(form):
            return [*plain, c]
        return [*plain, tuple(c.tolist()) if isinstance(form, int) else form(*c.tolist())]

    def _value(self, x, *others):
        given = self._given(x, *others)
        return on_every_side(lambda: np.array([*self._function(*given)], dtype=object), _graph_of(x, *others))

    def _matrix(self, x, scales, *others):
        if self._jacobian is not None:
            given = self._given(x, *others)
            rows = lambda: np.array([[*row] for row in self._jacobian(*given)], dtype=object)  # noqa: E731
            return on_every_side(rows, _graph_of(x, *others))
        value = self._value(x, *others)
        return np.array([_along(value, (x, unit)) for unit in np.eye(len(x))], dtype=object).T

    def _by_constants(self, x, scales, *others):
        given, (dc, _) = others[: self._others], others[self._others :]
        return _along(self._value(x, *given), (given[-1], dc))

    def _slope(self, x, scales, *others):
        given, (dx, *moves) = others[: self._others], others[self._others :]
        return _along(self._matrix(x, scales, *given), (x, dx), *((given[-1], dc) for dc in moves[:1]))

    def _values_of_points(self, points, *others):
        return np.array([self._value(x, *others) for x in points.T]).T

    def _slopes_of_points(self, points, scales, *others):
        given, (changes, *moves) = others[: self._others], others[self._others :]
        of_constants = [(given[-1], dc) for dc in moves[:1]]
        pairs = zip(points.T, changes.T, strict=True)
        return np.array([_along(self._value(x, *given), (x, dx), *of_constants) for x, dx in pairs]).T


def _graph_of(*arguments) -> Graph:
    """The graph of the numbers among some arguments, of which the state's are such."""
    return next(one.graph for argument in arguments for one in argument if isinstance(one, Number))


class Untraced:
    """A function of a model that cannot be traced."""

    def __init__(self):
        """Nothing is known of it."""
        self.parts, self.of_points = (not_known,) * 4, (not_known,) * 2


def traced_if_possible(*arguments) -> Traced | Untraced:
    """A function traced, as `Traced` takes it; of one that cannot be traced a stand-in."""
    try:
        return Traced(*arguments)
    except Exception:  # whatever a user's function raises of numbers that it does not know
        return Untraced()


def not_known(*arguments):
    """In place of a function that can only be called."""
    raise TypeError("a function that is called computes nothing of numbers that are not known yet")


def _values_at(arguments: list, functions: Sequence[Callable | None]) -> np.ndarray:
    """What functions return, one behind the other; NaN where they have no value."""
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            values = [np.array(one(*arguments), dtype=np.float64).ravel() for one in functions if one]
        except (ArithmeticError, ValueError, TypeError):  # also of complex numbers
            return np.array([np.nan])
    return np.concatenate(values)


def _along(y: np.ndarray, *moves: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """The slope of y where Numbers that are given move."""
    pairs = [(one, change) for given, changes in moves for one, change in zip(given, changes, strict=True)]
    graph = pairs[0][0].graph
    directions: dict = {one.place: graph.number(change) for one, change in pairs}
    if len(directions) < len(pairs):
        raise TypeError("numbers that move must differ from one another, but some are equal")
    directions = {place: None if change.value == 0.0 else change for place, change in directions.items()}
    found = along([graph.number(one) for one in y.ravel()], directions)
    return np.array([0.0 if one is None else one for one in found], dtype=object).reshape(y.shape)
