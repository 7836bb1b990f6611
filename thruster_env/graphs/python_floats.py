"""Functions of a model that run as Python: called with Python's floats, they have the values of machine code.

With NumPy's scalars a user's function may differ: (x > 0) + (y > 0) is at most 1, `case True` never matches, and
x/abs(x) is NaN where Python raises an exception that the function may catch. Python's floats raise where machine
code has infinity or NaN. So the function is called with Python's floats first. If it raises or returns complex
numbers, a copy of it is called with floats that follow IEEE 754.

Functions of a model that numba refuses, written out from their graphs: dictionaries, texts, imports, loggers.

    def f(x, u, c):                                  def from_graph(x, u, c):
        names = ["position", "speed"]                    t0 = x[0]
        gains = dict(zip(names, c))             is       t1 = c[0]
        logger.debug("gains %s", gains)                  t2 = t0 * t1
        return (gains["position"] * x[0],)               return (t2,)

Such a function prints and logs only while it is traced and where it runs as Python.
"""

from __future__ import annotations

import contextlib
import dis
import functools
import math
import re
import sys
import types
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from thruster_env.core.compiled import compiled_in_place_of, inlined, rounds
from thruster_env.core.equal_functions import makes_functions
from thruster_env.core.sources import matrix_of, tuple_of, written_out
from thruster_env.core.user_functions import (
    MODULES,
    Copies,
    Module,
    caught,
    codes_in,
    functions_in,
    inverts,
    is_plain,
    needs_floats,
    needs_python,
    stand_in,
    takes_roots,
)
from thruster_env.graphs.branches import on_every_side
from thruster_env.graphs.graphs import UNARY, Graph, Number
from thruster_env.graphs.programs import Place, program_of, values_of
from thruster_env.graphs.tracing import OTHER_NAMES, traced

MOST = 3000  # operations: beyond, functions run as they are
POINTS = ((0.1, 0.5), (1.0, 1.0), (1.0, 2.5), (10.0, 4.0))  # magnitudes and phases, where values are compared
REFUSED = {"IMPORT_NAME", "FORMAT_VALUE", "FORMAT_SIMPLE", "FORMAT_WITH_SPEC", "BUILD_MAP", "BUILD_CONST_KEY_MAP"}
BUILDING, EXTENDING = ("BUILD_LIST", "BUILD_SET"), ("LIST_EXTEND", "SET_UPDATE")
TWO = ("arctan2", "hypot", "copysign", "fmod", "rint")


def written_function(
    function: Callable, arguments: str, sizes: Sequence[int], form: type | int, shape: Sequence[int]
) -> Callable | None:
    """The same function of tuples, written out from its graph; None if numba takes it as it is.

    Args:
        function: of x, perhaps u, and constants c, or its Jacobian.
        arguments: their names, "x, u, c" or "x, c".
        sizes: number of components of each argument.
        form: of the constants, their NamedTuple class, or how many there are in a tuple.
        shape: of the result: (count,), or (rows, columns) of a tuple of rows.
    """
    if not is_refused(function) or needs_floats(function):
        return None
    try:
        return _written(function, arguments, sizes, form, tuple(shape))
    except Exception:  # whatever a user's function raises while it is traced
        return None


def is_refused(function: Callable) -> bool:
    """Whether numba would refuse a function, or take long over its dictionaries, judging by its code."""
    if not isinstance(function, types.FunctionType):
        return not hasattr(function, "py_func")
    return any(_has_odd_code(part.__code__) or _reads_odd_values(part) for part in functions_in(function))


def _has_odd_code(code: types.CodeType) -> bool:
    """Whether it has dictionaries, formats or imports, or lists or sets of texts, or lists in lists."""
    return any(
        instruction.opname in REFUSED or _is_odd_list(listed[:k], instruction)
        for listed in map(list, map(dis.get_instructions, codes_in(code)))
        for k, instruction in enumerate(listed)
    )


def _is_odd_list(before: Sequence[dis.Instruction], instruction: dis.Instruction) -> bool:
    """Whether an instruction makes a list or set of texts, or of lists."""
    if instruction.opname in EXTENDING:
        return before[-1].opname == "LOAD_CONST" and not _is_of_numbers(before[-1].argval)
    parts = before[-instruction.arg :] if instruction.opname in BUILDING and instruction.arg else []
    texts = (part.argval for part in parts if part.opname == "LOAD_CONST")
    return not all(map(_is_of_numbers, texts)) or any(part.opname in (*BUILDING, *EXTENDING) for part in parts)


def _is_of_numbers(value) -> bool:
    return all(map(_is_of_numbers, value)) if isinstance(value, (tuple, frozenset)) else not isinstance(value, str)


def _reads_odd_values(function: types.FunctionType) -> bool:
    """Whether it reads a dictionary, a logger or another object, or a module without functions of numbers."""
    names = function.__code__.co_names
    cells = [cell.cell_contents for cell in function.__closure__ or ()]
    functions = types.FunctionType, types.BuiltinFunctionType, np.ufunc, type(np.where), type
    return any(
        not (
            is_plain(value)
            or isinstance(value, functions)
            or hasattr(value, "py_func")
            or (isinstance(value, types.ModuleType) and value in MODULES)
        )
        for value in (*cells, *(function.__globals__[name] for name in names if name in function.__globals__))
    )


def _written(function: Callable, arguments: str, sizes: Sequence[int], form, shape: tuple[int, ...]) -> Callable:
    graph, ends = Graph(MOST), np.cumsum(sizes)[:-1]
    entries = [
        f"{name}[{i}]" for name, size in zip(arguments.split(", "), sizes, strict=True) for i in range(size)
    ]

    def result(of: Callable, numbers: np.ndarray) -> np.ndarray:
        *vectors, c = (tuple(part.tolist()) for part in np.split(numbers, ends))
        value = of(*vectors, c if isinstance(form, int) else form(*c))
        rows = [[*row] for row in value] if len(shape) == 2 else [*value]
        return np.array([*rows, None], dtype=object)[:-1] if len(shape) == 1 else np.array(rows, dtype=object)

    inputs = np.array([*(graph.given(Place("numbers", k)) for k in range(len(entries))), None], dtype=object)[:-1]
    trace = traced(function)
    outputs = on_every_side(lambda: result(trace, inputs), graph)
    if outputs.shape != shape:
        raise TypeError(f"a function must return values of shape {shape}, but got {outputs.shape}")
    numbers = [graph.number(output) for output in outputs.ravel()]
    _check(numbers, lambda point: result(function, point).astype(float).ravel(), len(entries), ends[-1])
    text = program_of([(Place("out", k), number) for k, number in enumerate(numbers)], {}).text
    text = [line.partition("  #")[0] for line in text]
    text = [re.sub(r"\bnumbers\[(\d+)\]", lambda at: entries[int(at[1])], line) for line in text]
    text = [re.sub(r"float\.fromhex\('(.*?)'\)", lambda of: repr(float.fromhex(of[1])), line) for line in text]
    lines, ends_of = text[: -len(numbers)], [line.partition(" = ")[2] for line in text[-len(numbers) :]]
    out = tuple_of(ends_of)
    if len(shape) == 2:
        out = matrix_of(*shape, lambda i, j: ends_of[i * shape[1] + j])
    known = {name: getattr(np, name) for name in (*UNARY, *TWO) if hasattr(np, name)}
    known |= {"erf": math.erf, "erfc": math.erfc, "inf": math.inf, "nan": math.nan}
    return written_out("from_graph", arguments, *lines, out, where=_chosen, **known)


def _check(numbers: Sequence[Number], values: Callable, count: int, first_constant: int) -> None:
    """Raise TypeError unless a graph has its function's values at some points, wherever these are finite."""
    agreed = False
    for magnitude, phase in POINTS:
        point = magnitude * np.sin(phase + np.arange(count))
        point[first_constant:] = 0.1 + abs(point[first_constant:])
        try:
            with np.errstate(all="ignore"):
                expected, actual = values(point), values_of(numbers, point[:, None])[:, 0]
        except (ArithmeticError, ValueError):
            continue
        if np.isfinite(expected).all():
            agreed = np.allclose(actual, expected, rtol=1e-9, atol=1e-9 * abs(expected).max(initial=0.0))
            if not agreed:
                break
    if not agreed:
        raise TypeError("a graph must have the values of its function, but has others or could not be compared")


@inlined
def _chosen(condition, a, b):
    return a if condition else b


WITHOUT_VALUE = ArithmeticError, ValueError, TypeError  # of 1/0, of sqrt(-1), of complex numbers that are compared


class _OfFloats(type):
    def __instancecheck__(cls, value) -> bool:
        return isinstance(value, float)


class Float(float, metaclass=_OfFloats):
    """A float whose quotients, powers and rests have a value where NumPy's have, unless exceptions are caught."""

    __slots__ = ()

    def __round__(self, digits=None):
        return _plain(round(float(self), digits)) if math.isfinite(self) else self


def _method(name: str) -> Callable:
    of_python, of_numpy = getattr(float, name), getattr(np.float64, name)

    def method(self, *arguments):
        try:
            result = of_python(self, *arguments)
        except ArithmeticError:
            if _is_caught():
                raise
            return _plain(of_numpy(np.float64(self), *arguments))
        if type(result) is float:
            return Float(result)
        return _plain(of_numpy(np.float64(self), *arguments) if isinstance(result, complex) else result)

    return method


def _whole(rounding: Callable) -> Callable:
    """A whole number; of what is not finite itself."""
    return lambda self: rounding(float(self)) if math.isfinite(self) else self


for _name in "floor ceil trunc".split():
    setattr(Float, f"__{_name}__", _whole(getattr(math, _name)))
for _name in "add sub mul truediv floordiv mod divmod pow".split():
    for _side in ("", "r"):
        setattr(Float, f"__{_side}{_name}__", _method(f"__{_side}{_name}__"))
for _name in "neg pos abs".split():
    setattr(Float, f"__{_name}__", _method(f"__{_name}__"))


def _plain(result: Any) -> Any:
    """A result with Floats in place of floats, and Python's truth values in place of NumPy's."""
    if isinstance(result, np.generic):
        result = result.item()
    if type(result) is tuple:
        return tuple(map(_plain, result))
    return Float(result) if type(result) is float else result


def _is_caught() -> bool:
    """Whether the user's code that is running catches exceptions where it is."""
    frame = sys._getframe(2)
    while frame is not None and frame.f_code is not _call_with_ieee.__code__:
        if any(first <= frame.f_lasti < end for first, end in caught(frame.f_code)):
            return True
        frame = frame.f_back  # type: ignore[assignment]
    return False


@functools.cache
def _replacement(module, name: str) -> Any:
    """What a copy finds under a name in `math` or NumPy: functions of the latter in place of what raises."""
    function = getattr(module, name)
    if function is np.linalg:
        return Module(np.linalg, _replacement)
    if not callable(function) or isinstance(function, type):
        return function

    def call(*arguments, **named):
        try:
            return _plain(function(*arguments, **named))
        except (ValueError, ArithmeticError) as error:
            if module is np or _is_caught():
                raise
            if isinstance(error, np.linalg.LinAlgError):  # of a singular matrix
                return np.full(np.shape(arguments[-1]), math.nan)
            of_numpy = getattr(np, OTHER_NAMES.get(name, name), None)
            if of_numpy is None and "domain" not in str(error):
                raise
            return math.nan if of_numpy is None else _plain(of_numpy(*arguments))

    return call


@functools.lru_cache(maxsize=64)
def _copy(function: Callable) -> Callable:
    return Copies(_replacement, {"float": Float}).called(function)


class Floats(np.ndarray):
    """An array of float64 whose entries are Python's numbers.

    Attributes:
        kind: of the floats.
    """

    kind: Callable = float

    def __array_finalize__(self, other):
        """Parts and results have the same entries."""
        self.kind = getattr(other, "kind", float)

    def __getitem__(self, index):
        """An entry as a number of Python, or a part of the array."""
        entry = super().__getitem__(index)
        return self._entry(entry) if isinstance(entry, np.generic) else entry

    def __iter__(self):
        return map(self.__getitem__, range(len(self)))

    def __array_wrap__(self, array, context=None, return_scalar=False):
        """A single result is a number of Python."""
        return self._entry(array[()]) if return_scalar else super().__array_wrap__(array, context, return_scalar)

    def _entry(self, value: np.generic) -> Any:
        plain = value.item()
        return self.kind(plain) if type(plain) is float else plain


def with_floats(kind: Callable, arguments: Sequence) -> list:
    """Arguments of a function with floats of a kind in the places of floats; others as they are."""
    converted: list = []
    for argument in arguments:
        if isinstance(argument, tuple):
            parts = [kind(part) if isinstance(part, float) else part for part in argument]
            converted.append(type(argument)(*parts) if hasattr(argument, "_fields") else tuple(parts))
        elif type(argument) is np.ndarray and argument.dtype == np.float64 and kind is not np.float64:
            converted.append(argument.view(Floats))
            converted[-1].kind = kind
        else:
            converted.append(argument)
    return converted


def _is_real(value: Any) -> bool:
    """Whether a number, or all of a vector or matrix, is not complex."""
    if isinstance(value, np.ndarray):
        return value.dtype.kind != "c"
    return all(map(_is_real, value)) if isinstance(value, (tuple, list)) else not isinstance(value, complex)


def _call_with_ieee(function: Callable, arguments: tuple) -> Any:
    return _copy(function)(*with_floats(Float, arguments))


@makes_functions
def with_python_floats(function: Callable, arguments: str = "", sizes=(), form=0, shape=()) -> Callable:
    """Return a function that calls another one with Python's floats; compiled code uses the original.

    If the function raises an exception that only Python's floats raise (1/0 is infinite in machine code, sqrt(-1)
    NaN), or returns complex numbers, the result follows IEEE 754, except for exceptions that the function catches.
    A function with a `~` gets NumPy's scalars, for which `~` negates truth values as in machine code. A function
    with roots gets floats of IEEE 754 at once, because Python's root of a negative number is complex.

    With the arguments of `written_function`, compiled code replaces a function that numba refuses by one from its
    graph.
    """
    written = written_function(function, arguments, sizes, form, shape) if arguments else None
    inlined(function)
    codes = [part.__code__ for part in functions_in(function)]
    kind = np.float64 if any(map(inverts, codes)) else Float if any(map(takes_roots, codes)) else float

    def called(*arguments):
        written  # noqa: B018 - part of the key of machine code
        failure: Exception = TypeError("a function of a model must return real numbers")
        try:
            result = function(*with_floats(kind, arguments))
            if _is_real(result):
                return result
        except WITHOUT_VALUE as error:
            failure = error
            if not any(isinstance(component, float) for component in arguments[0][:1]):  # Numbers or tensors
                raise
        with np.errstate(all="ignore"):
            for other in (_call_with_ieee, _call_with_numpy):
                with contextlib.suppress(*WITHOUT_VALUE):
                    return other(function, arguments)
        raise failure

    called.__name__, called.__module__ = (getattr(function, name, "") for name in ("__name__", "__module__"))
    if written is None:
        return compiled_in_place_of(called, function)
    return stand_in(compiled_in_place_of(called, written, rounded_as=function), function)


def _call_with_numpy(function: Callable, arguments: tuple) -> Any:
    """The result for NumPy's scalars, for which 1/(x > 0) has a value; their `%` of conditions is wrong."""
    if needs_python(function) or any(rounds(part.__code__) for part in functions_in(function)):
        raise TypeError
    return function(*with_floats(np.float64, arguments))
