"""Functions of a model that numba refuses, written out from their graphs: dictionaries, texts, imports, loggers.

    def f(x, u, c):                                  def from_graph(x, u, c):
        names = ["position", "speed"]                    t0 = x[0]
        gains = dict(zip(names, c))             is       t1 = c[0]
        logger.debug("gains %s", gains)                  t2 = t0 * t1
        return (gains["position"] * x[0],)               return (t2,)

Such a function prints and logs only while it is traced and where it runs as Python.
"""

from __future__ import annotations

import dis
import math
import re
import types
from collections.abc import Callable, Sequence

import numpy as np

from thruster_env.core.compiled import inlined
from thruster_env.core.sources import matrix_of, tuple_of, written_out
from thruster_env.core.user_functions import MODULES, codes_in, functions_in, is_plain, needs_floats
from thruster_env.graphs.branches import on_every_side
from thruster_env.graphs.graphs import UNARY, Graph, Number
from thruster_env.graphs.programs import Place, program_of, values_of
from thruster_env.graphs.tracing import traced

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
