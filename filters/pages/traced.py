"""A model's functions, traced: graphs of numbers, and their derivatives."""

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

MOST = 30_000  # operations of a stage; with more, programs without calls take longer to compile than calls
POINTS = ((0.1, 0.5), (1.0, 1.0), (1.0, 2.5), (10.0, 4.0))  # magnitudes and phases, where graphs are compared


@lru_cache(maxsize=64)
def traced_model(functions: Functions, shape: Shape, partly: bool = False) -> tuple[Traced | Untraced, ...]:
    """A model's f and h, traced once for all filters.

    If one cannot be traced: raises TypeError, or with `partly` returns an `Untraced` for it.
    """
    f, by_f, h, by_h = functions
    make: Callable = traced_if_possible if partly else Traced
    return make(f, by_f, 2, shape), make(h, by_h, 1, shape)


class Traced:
    """A function of a model that takes arrays of Numbers, and its derivatives.

    Attributes:
        parts: the function, its Jacobian, and the slopes of both, as operations of `Equations` take them.
        of_points: the function and its slope at each column of a matrix.
    """

    def __init__(self, function: Callable, jacobian: Callable | None, input_count: int, shape: Shape):
        self._function, self._input_count, self._shape = traced(function), input_count, shape
        self._jacobian = None if jacobian is None or by_complex_step(jacobian) else traced(jacobian)
        self.parts = self._value, self._matrix, self._by_constants, self._slope
        self.of_points = self._values_of_points, self._slopes_of_points
        self._check(function, jacobian)

    def _check(self, *functions: Callable | None) -> None:
        """Raise TypeError unless the graph has the functions' values at all points where these are finite.

        A function that checks the types of its arguments may treat Numbers differently from floats.
        """
        graph, shape = Graph(MOST), self._shape
        sizes = (shape.n, shape.inputs, shape.constants) if self._input_count == 2 else (shape.n, shape.constants)
        ends, agreed = np.cumsum(sizes), False
        x, *inputs = np.split(np.array([graph.given(Place("numbers", k)) for k in range(ends[-1])]), ends[:-1])
        graphs = [self._value(x, *inputs)]
        if self._jacobian is not None:
            graphs.append(self._matrix(x, None, *inputs))
        numbers = [graph.number(entry) for part in graphs for entry in part.ravel()]
        points = np.array([magnitude * np.sin(phase + np.arange(ends[-1])) for magnitude, phase in POINTS])
        points[:, ends[-2] :] = 0.1 + abs(points[:, ends[-2] :])  # constants
        with np.errstate(all="ignore"):
            all_computed = values_of(numbers, points.T).T
        for point, computed in zip(points, all_computed, strict=True):
            expected = _values_at(self._as_arguments(*np.split(point, ends[:-1])), functions[: len(graphs)])
            if np.isfinite(expected).all():
                agreed = np.allclose(computed, expected, rtol=1e-9, atol=1e-9 * abs(expected).max(initial=0.0))
                if not agreed:
                    raise TypeError("a function does something else with numbers that are not known yet")
        if not agreed:
            raise TypeError("a function has no value at any point where its graph could be compared with it")

    def _as_arguments(self, x, *inputs) -> list:
        """Arguments in the form in which the model takes them, components as Python's floats.

        With NumPy's floats (x > 0) + (y > 0) would be 1 where Python and machine code give 2.
        """
        *u, c = inputs
        for number in (*x, *c):  # along which slopes are taken
            if isinstance(number, Number):
                number.graph.whole.add(number.place)
        plain = [vector if is_array(len(vector)) else tuple(vector.tolist()) for vector in (x, *u)]
        form = self._shape.form
        if constants_are_array(form):
            return [*plain, c]
        return [*plain, tuple(c.tolist()) if isinstance(form, int) else form(*c.tolist())]

    def _value(self, x, *inputs):
        arguments = self._as_arguments(x, *inputs)
        return on_every_side(lambda: np.array([*self._function(*arguments)], dtype=object), _graph_of(x, *inputs))

    def _matrix(self, x, scales, *inputs):
        if self._jacobian is not None:
            arguments = self._as_arguments(x, *inputs)
            rows = lambda: np.array([[*row] for row in self._jacobian(*arguments)], dtype=object)  # noqa: E731
            return on_every_side(rows, _graph_of(x, *inputs))
        value = self._value(x, *inputs)
        return np.array([_along(value, (x, unit)) for unit in np.eye(len(x))], dtype=object).T

    def _by_constants(self, x, scales, *arguments):
        inputs, (dc, _) = arguments[: self._input_count], arguments[self._input_count :]
        return _along(self._value(x, *inputs), (inputs[-1], dc))

    def _slope(self, x, scales, *arguments):
        inputs, (dx, *moves) = arguments[: self._input_count], arguments[self._input_count :]
        return _along(self._matrix(x, scales, *inputs), (x, dx), *((inputs[-1], dc) for dc in moves[:1]))

    def _values_of_points(self, points, *inputs):
        return np.array([self._value(x, *inputs) for x in points.T]).T

    def _slopes_of_points(self, points, scales, *arguments):
        inputs, (changes, *moves) = arguments[: self._input_count], arguments[self._input_count :]
        of_constants = [(inputs[-1], dc) for dc in moves[:1]]
        pairs = zip(points.T, changes.T, strict=True)
        return np.array([_along(self._value(x, *inputs), (x, dx), *of_constants) for x, dx in pairs]).T


def _graph_of(*arguments) -> Graph:
    """The graph to which the Numbers among the arguments belong; those of the state always do."""
    return next(number.graph for argument in arguments for number in argument if isinstance(number, Number))


class Untraced:
    """A function of a model that cannot be traced: each part raises TypeError if it is evaluated."""

    def __init__(self):
        self.parts, self.of_points = (not_known,) * 4, (not_known,) * 2


def traced_if_possible(*arguments) -> Traced | Untraced:
    """`Traced` of the arguments, or `Untraced` if the function cannot be traced."""
    try:
        return Traced(*arguments)
    except Exception:  # whatever a user's function raises if it gets Numbers
        return Untraced()


def not_known(*arguments):
    """Stand in for a function that can only be called."""
    raise TypeError("a function that is called computes nothing of numbers that are not known yet")


def _values_at(arguments: list, functions: Sequence[Callable | None]) -> np.ndarray:
    """Results of functions, flat and concatenated; one NaN if a function raises an arithmetic error."""
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            values = [
                np.array(function(*arguments), dtype=np.float64).ravel() for function in functions if function
            ]
        except (ArithmeticError, ValueError, TypeError):  # also of complex numbers
            return np.array([np.nan])
    return np.concatenate(values)


def _along(y: np.ndarray, *moves: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """The slope of y along changes of Numbers, pairs of arrays (numbers, changes)."""
    pairs = [
        (number, change) for numbers, changes in moves for number, change in zip(numbers, changes, strict=True)
    ]
    graph = pairs[0][0].graph
    directions: dict = {number.place: graph.number(change) for number, change in pairs}
    if len(directions) < len(pairs):
        raise TypeError("numbers that move must differ from one another, but some are equal")
    directions = {position: None if change.value == 0.0 else change for position, change in directions.items()}
    slopes = along([graph.number(number) for number in y.ravel()], directions)
    return np.array([0.0 if slope is None else slope for slope in slopes], dtype=object).reshape(y.shape)
