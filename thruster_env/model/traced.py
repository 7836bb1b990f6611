"""A model's functions, traced: graphs of numbers, and their derivatives."""

from __future__ import annotations

import math
import traceback
import types
import warnings
import weakref
from collections.abc import Callable, Sequence
from functools import lru_cache
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from thruster_env.core.compiled import (
    FASTMATH,
    Instead,
    compiled_in_place_of,
    fastmath_of,
    functions_in,
    is_copy,
    needs_python,
    stand_in,
    stands_for,
    with_callees,
)
from thruster_env.core.derivatives import by_complex_step
from thruster_env.core.equal_functions import makes_functions
from thruster_env.core.modules import error_line
from thruster_env.core.sources import as_array, is_array, made_here, matrix_of, tuple_of, written_out
from thruster_env.graphs.branches import along, on_every_side
from thruster_env.graphs.graphs import Graph, Number, TooLarge
from thruster_env.graphs.programs import OF_STEPS, Place, Program, callable_of, program_of, values_of
from thruster_env.graphs.python_floats import in_python
from thruster_env.graphs.tracing import traced
from thruster_env.model.shape import Functions, Shape, constants_are_array

MOST = 30_000  # operations of a stage; with more, programs without calls take longer to compile than calls
MOST_TURNING = 300_000  # of a model with rotations, directions or poses, whose steps have no calls
POINTS = ((0.1, 0.5), (1.0, 1.0), (1.0, 2.5), (10.0, 4.0))  # magnitudes and phases, where graphs are compared


def most_operations(shape: Shape) -> int:
    """How many operations a program of a filter's stage may have."""
    return MOST_TURNING if shape.turns or shape.measured_turns else MOST


@lru_cache(maxsize=64)
def traced_model(functions: Functions, shape: Shape, partly: bool = False) -> tuple[Traced | Untraced, ...]:
    """A model's f and h, traced once for all filters.

    If one cannot be traced: raises TypeError, or with `partly` returns an `Untraced` for it.
    """
    f, by_f, h, by_h = functions
    make: Callable = traced_if_possible if partly else Traced
    return make(f, by_f, "motion", shape), make(h, by_h, "sight", shape)


def traced_function(function: Callable, *about) -> TracedFunction:
    """A function of a model, or its Jacobian, traced once for all uses; arguments as of `TracedFunction`."""
    return _traced_once(stands_for(function), *about)


@lru_cache(maxsize=128)
def _traced_once(*arguments) -> TracedFunction:
    return TracedFunction(*arguments)


class TracedFunction:
    """A function of a model that takes arrays of Numbers.

    Args:
        function: of x, perhaps u, and constants c.
        sizes: number of components of each.
        form: of the constants, their NamedTuple class, or how many there are in a tuple.
        shape: of the result: (count,), or (rows, columns) of a tuple of rows.

    Raises:
        TypeError: if it cannot be traced, or its graph has other values than it has. Whatever else the function
            raises if it gets Numbers is raised, too.
    """

    def __init__(self, function: Callable, sizes: tuple[int, ...], form: type | int, shape: tuple[int, ...]):
        self._sizes, self._form, self._shape = sizes, form, shape
        plain = _of_plain_constants(function, form)
        try:
            self._copy = traced(plain)
            self._check(plain)
        except Exception:  # a function that it calls changes its arguments, or returns what cannot be joined
            self._copy = traced(plain, by_function=False)
            self._check(plain)

    def __call__(self, *vectors: np.ndarray) -> np.ndarray:
        """The result for vectors, of which the first has Numbers."""
        arguments = self._as_vectors(*vectors)
        for number in (*vectors[0], *vectors[-1]):  # along which slopes are taken
            if isinstance(number, Number):
                number.graph.whole.add(number.place)

        def result() -> np.ndarray:
            value = self._copy(*arguments)
            values = np.array([[*row] for row in value] if len(self._shape) == 2 else [*value], dtype=object)
            if values.shape != self._shape:
                raise TypeError(f"a function must return values of shape {self._shape}, but got {values.shape}")
            return values

        return on_every_side(result, _graph_of(*vectors))

    def _as_vectors(self, *vectors: np.ndarray) -> list:
        """Arguments as tuples of Python's floats, or arrays if they are large.

        With NumPy's floats (x > 0) + (y > 0) would be 1 where Python and machine code give 2.
        """
        *before, c = vectors
        plain = [vector if is_array(len(vector)) else tuple(vector.tolist()) for vector in before]
        return [*plain, c if constants_are_array(self._form) else tuple(c.tolist())]

    def program(self) -> Program:
        """The program that reads the arguments' components from `numbers` and stores the result in `rows`."""
        return program_of([(Place("rows", k), number) for k, number in enumerate(self._numbers())], {})

    def _numbers(self) -> list[Number]:
        graph, ends = Graph(MOST), np.cumsum(self._sizes)
        components = np.array([graph.given(Place("numbers", k)) for k in range(ends[-1])], dtype=object)
        return [graph.number(entry) for entry in self(*np.split(components, ends[:-1])).ravel()]

    def _check(self, function: Callable) -> None:
        """Raise TypeError unless the graph has the function's values at all points where these are finite.

        A function that checks the types of its arguments may treat Numbers differently from floats.
        """
        numbers, ends, agreed = self._numbers(), np.cumsum(self._sizes), False
        points = np.array([magnitude * np.sin(phase + np.arange(ends[-1])) for magnitude, phase in POINTS])
        points[:, ends[-2] :] = 0.1 + abs(points[:, ends[-2] :])  # constants
        with np.errstate(all="ignore"):
            all_computed = values_of(numbers, points.T).T
        for point, computed in zip(points, all_computed, strict=True):
            expected = _value_at(function, self._as_vectors(*np.split(point, ends[:-1])))
            if np.isfinite(expected).all():
                agreed = np.allclose(computed, expected, rtol=1e-9, atol=1e-9 * abs(expected).max(initial=0.0))
                if not agreed:
                    raise TypeError("a function does something else with numbers that are not known yet")
        if not agreed:
            raise TypeError("a function has no value at any point where its graph could be compared with it")


def _of_plain_constants(function: Callable, form: type | int) -> Callable:
    """A function that gets its constants as they are in memory, for another one that gets them in their form."""
    if isinstance(form, int):
        return function

    def of_plain(*arguments):
        *vectors, c = arguments
        return function(*vectors, form(*c))

    return of_plain


class Traced:
    """A function of a model that takes arrays of Numbers, and its derivatives.

    Attributes:
        parts: the function, its Jacobian, and the slopes of both, as operations of `Equations` take them.
        of_points: the function and its slope at each column of a matrix.
    """

    def __init__(self, function: Callable, jacobian: Callable | None, which: str, shape: Shape):
        moves = which == "motion"
        self._input_count = 2 if moves or shape.feeds else 1
        sizes = (shape.n, shape.inputs, shape.constants) if self._input_count == 2 else (shape.n, shape.constants)
        rows = shape.n if moves else shape.channels
        self._function = traced_function(function, sizes, shape.form, (rows,))
        self._jacobian = None
        if jacobian is not None and not by_complex_step(jacobian):
            self._jacobian = traced_function(jacobian, sizes, shape.form, (rows, shape.n))
        self.parts = self._value, self._matrix, self._by_constants, self._slope
        self.of_points = self._values_of_points, self._slopes_of_points

    def _value(self, x, *inputs):
        return self._function(x, *inputs)

    def _matrix(self, x, scales, *inputs):
        if self._jacobian is not None:
            return self._jacobian(x, *inputs)
        value = self._value(x, *inputs)
        return np.array([slopes_along(value, (x, unit)) for unit in np.eye(len(x))], dtype=object).T

    def _by_constants(self, x, scales, *arguments):
        inputs, (dc, _) = arguments[: self._input_count], arguments[self._input_count :]
        return slopes_along(self._value(x, *inputs), (inputs[-1], dc))

    def _slope(self, x, scales, *arguments):
        inputs, (dx, *moves) = arguments[: self._input_count], arguments[self._input_count :]
        return slopes_along(self._matrix(x, scales, *inputs), (x, dx), *((inputs[-1], dc) for dc in moves[:1]))

    def _values_of_points(self, points, *inputs):
        return np.array([self._value(x, *inputs) for x in points.T]).T

    def _slopes_of_points(self, points, scales, *arguments):
        inputs, (changes, *moves) = arguments[: self._input_count], arguments[self._input_count :]
        of_constants = [(inputs[-1], dc) for dc in moves[:1]]
        pairs = zip(points.T, changes.T, strict=True)
        return np.array([slopes_along(self._value(x, *inputs), (x, dx), *of_constants) for x, dx in pairs]).T


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


def _value_at(function: Callable, arguments: list) -> np.ndarray:
    """The result of a function, flat; one NaN if it raises an exception."""
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return np.array(in_python(function, arguments), dtype=np.float64).ravel()
        except Exception:  # whatever a user's function raises
            return np.array([np.nan])


def slopes_along(y: np.ndarray, *moves: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """The slope of y along changes of Numbers, pairs of vectors (numbers, changes)."""
    pairs = [
        (number, change) for numbers, changes in moves for number, change in zip(numbers, changes, strict=True)
    ]
    graph = pairs[0][0].graph
    directions: dict = {}
    for number, change in pairs:
        change = graph.number(change)
        if directions.setdefault(number.place, change) is not change:
            raise TypeError("equal numbers must move alike, but some differ")
    directions = {position: None if change.value == 0.0 else change for position, change in directions.items()}
    slopes = along([graph.number(number) for number in y.ravel()], directions)
    return np.array([0.0 if slope is None else slope for slope in slopes], dtype=object).reshape(y.shape)


# A model's functions as others call them: machine code of their graphs, else of their loops.
#
#     def f(x, u, c):                                               def f(x, u, c):
#         pull = [k.force(y) for k, y in zip(SPRINGS, x)]    is         evaluate a program
#         return tuple(x[i] + c.dt * ...)                               return its results
#
# So loops over known numbers, comprehensions, arrays, dataclasses and dictionaries are machine code wherever a
# model is used. Loops over large arrays and until a value is small are translated by `graphs.loops`. What neither
# takes numba compiles, in each process anew, if it can; else the model runs as Python, and one warning names the
# function, the line, the reason and what to write in its place.


MOST_CALLED = 3000  # operations of a program: with more, LLVM takes seconds


@makes_functions
def called_function(
    function: Callable, arguments: str, sizes: tuple[int, ...], form: type | int, shape: tuple[int, ...]
) -> Callable:
    """Return a function of a model that calls it with Python's floats; compiled functions call its machine code.

    Args:
        function: of x, perhaps u, and constants c, or its Jacobian.
        arguments: their names, "x, u, c" or, of h without input, "x, c".
        sizes: number of components of each argument.
        form: of the constants, their NamedTuple class, or how many there are in a tuple.
        shape: of the result, which is an array if it is large: (count,), or (rows, columns) of a tuple of rows.
    """

    def called(*arguments):
        result = in_python(function, arguments)
        return np.array(result, dtype=np.float64) if is_array(*shape) else result

    called.__name__, called.__module__ = (getattr(function, name, "") for name in ("__name__", "__module__"))
    stand_in(called, function)
    return compiled_in_place_of(called, lambda: _machine_code(function, arguments, sizes, form, shape))


def _machine_code(
    function: Callable, arguments: str, sizes: Sequence[int], form, shape: tuple[int, ...]
) -> Instead:
    """Machine code of a function's graph, or of its loops, else of numba's."""
    parts, of_loops = (
        [*functions_in(function)],
        _of_floats(_array_valued(function, arguments, *shape), arguments, shape),
    )
    large = is_array(max(sizes[:-1])) or is_array(*shape)
    if (large or not parts) and _is_translated(of_loops, sizes, form):
        return Instead(of_loops)
    try:
        program = traced_function(function, sizes, form, shape).program()
        if len(program.works) > MOST_CALLED:
            raise TooLarge(f"has {len(program.works)} operations, of which {MOST_CALLED} compile in seconds")
        return Instead(_evaluation(program, arguments, sizes, shape))
    except Exception as error:  # whatever a user's function raises if it gets Numbers
        reason = why_not_traced(function, error)
    if needs_python(function):
        return Instead(None, reason)
    if _is_translated(of_loops, sizes, form):
        return Instead(of_loops, reason)
    if not isinstance(function, types.FunctionType) and not hasattr(function, "py_func"):
        return Instead(None, f"{reason}; numba takes no {type(function).__name__}")
    try:
        return Instead(_by_numba(function, sizes, form, shape), reason)
    except Exception as error:  # numba's, of many classes
        return Instead(None, f"{reason}; numba refuses it: {_reason(error)}")


@makes_functions
def _array_valued(function: Callable, arguments: str, *shape: int) -> Callable:
    """A function whose result is an array where vectors or matrices of its shape are (`is_array`).

    So a user's function may return tuples, or arrays, of any size.
    """
    return function if made_here(function) else as_array(function, arguments, *shape)


@makes_functions
def _of_floats(function: Callable, arguments: str, shape: tuple[int, ...]) -> Callable:
    """The function with floats in its result, a tuple, where it may return whole numbers."""
    if is_array(*shape):
        return function
    entry = "float(y[{}])".format
    result = (
        tuple_of(map(entry, range(*shape)))
        if len(shape) == 1
        else matrix_of(shape[0], shape[1], lambda i, j: entry(f"{i}][{j}"))
    )
    return written_out("of_floats", arguments, f"y = function({arguments})", result, function=function)


def _is_translated(function: Callable, sizes: Sequence[int], form: type | int) -> bool:
    """Whether `graphs.loops` can translate a function of vectors and constants: loops are shorter than a graph."""
    from thruster_env.graphs.loops import refusal_of, unknown

    *before, count = sizes
    vectors = [unknown(size, as_array=is_array(size)) for size in before]
    constants = unknown(count, as_array=constants_are_array(form))
    return not refusal_of(function, [*vectors, constants if isinstance(form, int) else form(*constants)])


def _evaluation(program: Program, arguments: str, sizes: Sequence[int], shape: Sequence[int]) -> Callable:
    """The function of tuples or arrays that evaluates a program."""
    work, count = callable_of(program, 1, OF_STEPS), int(np.prod(shape))

    def evaluate(vectors, out=None):
        numbers = np.concatenate([np.asarray(vector, dtype=np.float64) for vector in vectors])
        results = np.empty(count)
        work(results, numbers, numbers)
        if out is None:
            return tuple(results) if len(shape) == 1 else tuple(map(tuple, results.reshape(shape)))
        out[...] = results.reshape(shape)

    evaluate.evaluation = work, shape, sizes  # type: ignore[attr-defined]  # of which `loops` makes a call
    large = is_array(*shape)
    lines = [f"out = np.empty({shape})", f"evaluate(({arguments}, ), out)"] if large else []
    result = "out" if large else f"evaluate(({arguments}, ))"
    return written_out("of_graph", arguments, *lines, result, evaluate=evaluate, np=np)


_known: weakref.WeakSet[Callable] = weakref.WeakSet()  # functions that others may call


def _by_numba(function: Callable, sizes: Sequence[int], form: type | int, shape: tuple[int, ...]) -> Callable:
    """A function that numba compiles, which raises if numba refuses it; NaN is what it does not return."""
    import numba
    from numba.extending import register_jitable

    from thruster_env.graphs.expressions import Native

    plain = getattr(function, "py_func", function)
    for part in with_callees([plain]):
        if part not in _known:
            register_jitable(fastmath=fastmath_of(part), boundscheck=True)(part)
            _known.add(part)
    lines, at = [f"numbers, out = carray(given, {sum(sizes)}), carray(results, {prod(shape)})", "out[:] = nan"], 0
    arguments = [f"v{i}" for i in range(len(sizes))]
    for argument, size in zip(arguments, sizes, strict=True):
        entries = tuple_of(f"numbers[{k}]" for k in range(at, at + size))
        if argument == arguments[-1]:
            text = f"Constants(*{entries})" if not isinstance(form, int) else entries
            as_array = constants_are_array(form)
        else:
            text, as_array = entries, is_array(size)
        lines.append(f"{argument} = numbers[{at}:{at + size}]" if as_array else f"{argument} = {text}")
        at += size
    lines += "try:", f"    y = function({', '.join(arguments)})"
    lines += (f"    out[{k}] = y[{']['.join(map(str, i))}]" for k, i in enumerate(np.ndindex(*shape)))
    lines += "except Exception:", "    pass"
    names = {"carray": numba.carray, "nan": math.nan, "function": plain, "Constants": form}
    native = written_out("native", "given, results", *lines, "None", **names)
    pointer = numba.types.CPointer(numba.float64)
    options: Any = {"fastmath": set(FASTMATH), "error_model": "numpy", "boundscheck": True}
    code = numba.cfunc(numba.void(pointer, pointer), **options)(native)

    def call(*arguments):
        return function(*arguments)

    call.native = Native(code.address, shape, is_array(*shape), code)  # type: ignore[attr-defined, arg-type]
    return call


def _reason(error: Exception) -> str:
    # numba frames its reason with lines on where it was; the first that is none of those says what is wrong.
    frames = *"TypingError During Overload Rejected File >>>".split(), "Failed in", "There are", "- Of which"
    frames += "With argument", "No impl"
    lines = [line.strip() for line in str(error).splitlines()]
    telling = [line for line in lines if len(line) > 3 and not line.startswith(frames)]
    reason = telling[0] if telling else type(error).__name__
    calls = [line.removeprefix(">>>").strip() for line in lines if line.startswith(">>>")]
    unmatched = reason.lower().startswith(("no match", "raised from"))  # where only the call itself is telling
    return f"it has no {calls[0]}" if unmatched and calls else reason


TABLES = "look values up by np.interp, of at most a hundred points, or choose by if"
REMEDIES = {  # words of a reason, and what to write instead
    "decide": "loop a fixed number of times, and choose by min, max or np.where",
    "outcomes": "choose by min, max or np.where in place of so many ifs",
    "catches": "ask before, by an if, in place of try",
    "is` True": "compare by == in place of `is`",
    "operations": "use fewer substeps, or loops that numba takes",
    "hash": TABLES,
    "integer": TABLES,
    "int()": TABLES,
    "indices": TABLES,
}
OTHERWISE = "use arithmetic and functions of math and numpy that docs/machine_code.md names"


def why_not_traced(function: Callable, error: Exception) -> str:
    """The name of a function, its file and line, why it cannot be traced, and what to write in its place."""
    frames = [frame for frame, _ in traceback.walk_tb(error.__traceback__) if is_copy(frame)]
    lines = [line for frame, line in traceback.walk_tb(error.__traceback__) if is_copy(frame)]
    code = frames[-1].f_code if frames else getattr(function, "__code__", None)
    where = getattr(function, "__name__", type(function).__name__) if code is None else code.co_name
    if code is not None:
        where += f" ({Path(code.co_filename).name}, line {lines[-1] if lines else code.co_firstlineno})"
    text = str(error).split("\n")[0] if isinstance(error, TypeError) else error_line(error)
    remedy = next((remedy for words, remedy in REMEDIES.items() if words in text), OTHERWISE)
    return f"{where} cannot be traced, because {text}: {remedy}"
