"""Tracing of plain functions of floats: called with Numbers, they build a graph.

A user's function calls `math.sin(x)`, which needs a float, or `max(x, 0.0)`, which decides. So `traced` copies it
with our functions under these names, and copies all functions that it calls in the same way:

    traced(lambda x: max(math.sin(x[0]), 0.0))((number,))

A function that branches (`if x > 0.0`, `while error > 1e-9`), looks a number up in a table or passes it to a
function of floats raises TypeError: it cannot be traced and is called as it is. The exception is a few branches,
of which `branches` traces all sides.
"""

from __future__ import annotations

import dis
import inspect
import math
import operator
import threading
import types
from collections.abc import Callable, Iterator

import numpy as np

from thruster_env.core.compiled import Copies, Module, needs_floats
from thruster_env.core.streams import nearest_whole
from thruster_env.graphs.branches import on_every_side
from thruster_env.graphs.folding import worked_out
from thruster_env.graphs.graphs import UNARY, Number, arctan2, where

MOST_POINTS = 100  # of a table that is traced
MOST_ROWS = 4  # of a matrix whose determinant is written out
OTHER_NAMES = {
    **{f"a{name}": f"arc{name}" for name in "tan tan2 sin cos sinh cosh tanh".split()},
    "fabs": "absolute",
    "abs": "absolute",
    "pow": "power",
    "mod": "remainder",
    "around": "round",
    "rint": "round",
    "fix": "trunc",
    "deg2rad": "radians",
    "rad2deg": "degrees",
}
"""NumPy's names of functions of `math`, and one of those that it has twice."""


def _operation(name: str) -> Callable:
    return lambda *numbers: worked_out(name, *_numbers(*numbers))


def _numbers(*values) -> list[Number]:
    """Values as Numbers of the graph of those that are."""
    graph = next(value for value in values if isinstance(value, Number)).graph
    return [graph.number(value) for value in values]


def _chosen_by(is_better: Callable) -> Callable:
    def function(*numbers):
        chosen, *rest = numbers[0] if len(numbers) == 1 else numbers
        for number in rest:
            chosen = where(is_better(number, chosen), number, chosen)
        return chosen

    return function


_largest, _smallest = _chosen_by(operator.gt), _chosen_by(operator.lt)


def _extreme(choose: Callable) -> Callable:
    """The larger or smaller one of two as NumPy has it: NaN if one of them is."""

    def function(a, b):
        if not isinstance(a, Number) or a.value is not None:
            a, b = b, a
        return where(b == b, choose(a, b), b)

    return function


def _nearest_whole(x):
    """`streams.nearest_whole`: it jumps, but a sine or cosine of the rest does not, so rounding may be free."""
    if not isinstance(x, Number):
        return nearest_whole(x)
    with x.graph.as_written(False):
        return (x + 0.5).floor()


def _hypotenuse(x, y=0.0, *rest):
    length = worked_out("hypot", *_numbers(x, y))
    return _hypotenuse(length, *rest) if rest else length


def _clipped(x, a_min=None, a_max=None, *, min=None, max=None):
    low, high = a_min if min is None else min, a_max if max is None else max
    x = x if low is None else FUNCTIONS["maximum"](x, low)
    return x if high is None else FUNCTIONS["minimum"](x, high)


def _rounded(x, decimals=0):
    unit = 10.0 ** abs(decimals)
    if decimals > 0:
        return round(x * unit) / unit
    return round(x / unit) * unit if decimals < 0 else round(x)


def _nearest_rest(x, n):
    """The rest of x/n rounded to the nearest whole number, of two such the even one, as IEEE 754 has it."""
    x, n = _numbers(x, n)
    size = abs(n)
    rest = abs(worked_out("fmod", x, 2.0 * size))
    once = where(rest > 0.5 * size, rest - size, rest)
    rest = where((rest > 0.5 * size) & (once >= 0.5 * size), once - size, once)
    return where(x < 0.0, -rest, rest)


def _logarithm(x, base):
    return x.log() if base.value == math.e else x.log() / base.log()


def _step(x, at_zero):
    return where(x > 0.0, 1.0, where(x == 0.0, at_zero, where(x < 0.0, 0.0, x)))


def _log_of_sum(a, b):
    """log(exp(a) + exp(b)), with the slope of the mean where both are equal."""
    result = where(a > b, a + (b - a).exp().log1p(), b + (a - b).exp().log1p())
    return where((a == b) & (abs(a) == math.inf), a, result)


def _interpolated(x, xp, fp, left=None, right=None, period=None):
    """Lines between the points of a table; at one of these, the slope of the line to its right."""
    xp, fp = np.asarray(xp, dtype=float), np.asarray(fp, dtype=object)
    if period is not None or not 1 < len(xp) <= MOST_POINTS or not (np.diff(xp) > 0.0).all():
        raise TypeError(f"a traced table must have from 2 to {MOST_POINTS} increasing points and no period")

    def at(x):
        value = where(x > xp[-1], fp[-1] if right is None else right, fp[-1])
        for j in reversed(range(len(xp) - 1)):
            line = (fp[j + 1] - fp[j]) / (xp[j + 1] - xp[j]) * (x - xp[j]) + fp[j]
            value = where(x < xp[j + 1], line, value)
        return where(x == x, where(x < xp[0], fp[0] if left is None else left, value), x)

    return _elementwise(at)(x)


def _polynomial(p, x):
    value, *rest = p
    for coefficient in rest:
        value = value * x + coefficient
    return value


def _variance(a, axis=None, dtype=None, out=None, ddof=0, keepdims=False):
    a = np.asarray(a, dtype=object)
    count = a.size if axis is None else a.shape[axis]
    off = a - np.sum(a, axis=axis, keepdims=True) / count
    return np.sum(off * off, axis=axis, keepdims=keepdims) / (count - ddof)


def _selected(conditions, choices, default=0):
    for condition, choice in reversed(list(zip(conditions, choices, strict=True))):
        default = _replacement(np, "where")(condition, choice, default)
    return default


def _square_matrix(a) -> np.ndarray:
    a = np.asarray(a, dtype=object)
    if a.ndim != 2 or a.shape[0] != a.shape[1] or not 0 < len(a) <= MOST_ROWS:
        raise TypeError(
            f"a traced matrix must be one of at most {MOST_ROWS} rows to have a determinant or an inverse"
        )
    return a


def _determinant(a):
    """By the first row; that of no rows is 1."""
    a = _square_matrix(a) if len(a) else a
    terms = [(-1.0) ** j * a[0, j] * _determinant(_minor(a, 0, j)) for j in range(len(a))]
    return sum(terms[1:], terms[0]) if terms else 1.0


def _minor(a: np.ndarray, row: int, column: int) -> np.ndarray:
    return np.delete(np.delete(a, row, 0), column, 1)


def _solved(a, b):
    """X of A x = b, by the inverse's numerators and the determinant."""
    a, b = _square_matrix(a), np.asarray(b, dtype=object)
    indices = range(len(a))
    numerators = [[(-1.0) ** (i + j) * _determinant(_minor(a, j, i)) for j in indices] for i in indices]
    return np.array(numerators, dtype=object) @ b / _determinant(a)


def _norm(x, ord=None, axis=None, keepdims=False):
    x = np.asarray(x, dtype=object)
    if axis is not None or keepdims or ord is not None and (ord, x.ndim) not in ((2, 1), ("fro", 2)):
        raise TypeError("a traced norm must be that of a vector or Frobenius'")
    return sum(entry * entry for entry in x.ravel()).sqrt()


def _condition(x):
    return (x if x.is_condition else x != 0.0) if isinstance(x, Number) else bool(x)


FUNCTIONS: dict[str, Callable] = {
    **{name: _operation(name) for name in (*UNARY, "fmod", "copysign")},
    "absolute": abs,
    "power": lambda x, e: x**e,
    "square": lambda x: x * x,
    "hypot": _hypotenuse,
    "sign": lambda x: where(x > 0.0, 1.0, where(x < 0.0, -1.0, where(x == x, 0.0, math.nan))),
    "where": where,
    "arctan2": arctan2,
    "arcsin": lambda x: arctan2(x, ((1.0 - x) * (1.0 + x)).sqrt()),
    "arccos": lambda x: arctan2(((1.0 - x) * (1.0 + x)).sqrt(), x),
    "maximum": _extreme(_largest),
    "minimum": _extreme(_smallest),
    "fmax": lambda a, b: where(a == a, _largest(a, b), b),
    "fmin": lambda a, b: where(a == a, _smallest(a, b), b),
    "clip": _clipped,
    "remainder": operator.mod,
    "floor_divide": operator.floordiv,
    "trunc": lambda x: where(x < 0.0, x.ceil(), x.floor()),
    "round": _rounded,
    "heaviside": _step,
    "degrees": lambda x: x * (180.0 / math.pi),
    "radians": lambda x: x * (math.pi / 180.0),
    "isnan": lambda x: x != x,
    "isinf": lambda x: abs(x) == math.inf,
    "isfinite": lambda x: abs(x) < math.inf,
    "logaddexp": lambda a, b: _log_of_sum(*_numbers(a, b)),
    "reciprocal": lambda x: 1.0 / x,
    "float_power": lambda x, e: x**e,
    "logical_and": lambda a, b: _condition(a) & _condition(b),
    "logical_or": lambda a, b: _condition(a) | _condition(b),
    "logical_xor": lambda a, b: _condition(a) != _condition(b),
    "logical_not": lambda a: a == 0.0,
    "greater": operator.gt,
    "greater_equal": operator.ge,
    "less": operator.lt,
    "less_equal": operator.le,
    "equal": operator.eq,
    "not_equal": operator.ne,
}
"""In place of functions of `math` and NumPy, by NumPy's names, where they get a Number."""

OF_ARRAYS: dict[str, Callable] = {
    "interp": _interpolated,
    "polyval": _polynomial,
    "var": _variance,
    "std": lambda *arguments, **named: _replacement(np, "sqrt")(_variance(*arguments, **named)),
    "select": _selected,
}
"""In place of NumPy's functions of vectors, where there is a Number among these."""

OF_MATRICES: dict[str, Callable] = {
    "det": _determinant,
    "solve": _solved,
    "inv": lambda a: _solved(a, np.eye(len(a))),
    "norm": _norm,
}
"""The same of `numpy.linalg`."""

OF_MATH: dict[str, Callable] = {
    "log": lambda x, base=math.e: _logarithm(*_numbers(x, base)),
    "remainder": _nearest_rest,
    "dist": lambda p, q: _hypotenuse(*(a - b for a, b in zip(p, q, strict=True))),
    "fsum": sum,
}
"""In place of functions of `math` that NumPy has otherwise, or has not."""


class _OfFloats(type):
    def __instancecheck__(cls, value) -> bool:
        return isinstance(value, float | Number)


class _Float(metaclass=_OfFloats):
    """In place of `float`: a Number stays one, and `values.astype(float)` an array of Numbers."""

    def __new__(cls, value=0.0):
        if isinstance(value, str) and "<number " in value:
            raise TypeError("a number must not be read from a text of another one, whose digits are not known yet")
        return +value if isinstance(value, Number) else float(value)


BUILTINS = {
    "max": _largest,
    "min": _smallest,
    "float": _Float,
    "bool": _condition,
    "pow": pow,
    "print": lambda *_, **__: None,  # the numbers are unknown
}


def _replacement(module: types.ModuleType, name: str):
    value, name = getattr(module, name), OTHER_NAMES.get(name, name)
    if value is np.linalg:
        return Module(np.linalg, _replacement)
    if value is np.float64:
        return _Float
    of_arrays = OF_MATRICES.get(name) if module is np.linalg else OF_ARRAYS.get(name) if module is np else None
    of_numbers = None if module is np.linalg else FUNCTIONS.get(name)
    ours = of_arrays or module is math and OF_MATH.get(name) or of_numbers
    if not ours and (isinstance(value, type | np.ufunc) or not callable(value)):
        return value
    if not (module is math or of_arrays) and ours:
        ours = _elementwise(ours)

    def function(*arguments, **named):
        if any(map(_has_numbers, (*arguments, *named.values()))):
            return (ours or value)(*arguments, **{name: _open_kind(part) for name, part in named.items()})
        return _open(value(*map(_closed, arguments), **{name: _closed(part) for name, part in named.items()}))

    return function


def _open(value):
    """Arrays of floats as such that Numbers may be written to."""
    if isinstance(value, tuple):
        return type(value)(*map(_open, value)) if hasattr(value, "_fields") else tuple(map(_open, value))
    return value.astype(object) if isinstance(value, np.ndarray) and value.dtype == np.float64 else value


def _closed(value):
    """Arrays without Numbers as arrays of floats, and the kind of floats."""
    if isinstance(value, list | tuple) and not hasattr(value, "_fields"):
        return type(value)(map(_closed, value))
    if isinstance(value, np.ndarray) and value.dtype == object:
        return value.astype(np.float64)
    return np.float64 if value is _Float else value


def _open_kind(value):
    """The kind of entries of an array that gets Numbers."""
    return object if value is _Float else value


def _elementwise(function: Callable) -> Callable:
    """A function of numbers as one of arrays, too."""

    def of_arrays(*arguments, **named):
        if not any(isinstance(argument, (np.ndarray, list, tuple)) for argument in arguments):
            return function(*arguments, **named)
        entries = np.frompyfunc(lambda *entry_arguments: function(*entry_arguments, **named), len(arguments), 1)
        with np.errstate(all="ignore"):  # of NaN among constants
            return entries(*(np.asarray(argument, dtype=object) for argument in arguments))

    return of_arrays


def _has_numbers(value) -> bool:
    if isinstance(value, np.ndarray):
        return value.dtype == object and any(isinstance(entry, Number) for entry in value.flat)
    return isinstance(value, Number) or isinstance(value, (list, tuple)) and any(map(_has_numbers, value))


def traced(function: Callable, by_function: bool = True) -> Callable:
    """A copy of a function that takes Numbers; it raises TypeError where these cannot replace floats.

    With `by_function` each function that it calls has its branches joined by itself, see `branches`; one that
    changes its arguments, or returns what cannot be joined, raises TypeError.

    Raises:
        TypeError: for a function that needs floats: it catches exceptions, or asks whether a comparison `is` True.
    """
    if reason := needs_floats(function):
        raise TypeError(reason)
    now = threading.local()  # the graph, in each thread that traces the function

    def joined_by_itself(copy: types.FunctionType) -> Callable:
        if copy.__code__ is nearest_whole.__code__:
            return _nearest_whole
        return _on_all_sides(copy, now) if by_function and _may_decide(copy.__code__) else copy

    copies = Copies(_replacement, BUILTINS, silent=True, of_array=_open, of_function=joined_by_itself)
    copy = copies.of(function)

    def as_written(*arguments):
        known = next(_numbers_in(arguments), None)
        if known is None:
            return copy(*arguments)
        now.graph = known.graph
        with known.graph.as_written():
            return copy(*arguments)

    return as_written


def _on_all_sides(function: Callable, now: threading.local) -> Callable:
    """A function whose branches are joined where it returns, within `on_every_side` of the graph `now`."""

    def joined(*arguments, **named):
        graph = getattr(now, "graph", None)  # of a function that is called with floats there is none
        if graph is None or graph.decide is None:
            return function(*arguments, **named)
        before = [*_identities(arguments), *_identities(named)]

        def result():
            if before != [*_identities(arguments), *_identities(named)]:
                raise TypeError("a function that decides must not change its arguments")
            return function(*arguments, **named)

        return on_every_side(result, graph)

    return joined


def _may_decide(code: types.CodeType) -> bool:
    """Whether code has branches, and all of it runs when it is called."""
    runs_later = code.co_flags & (inspect.CO_GENERATOR | inspect.CO_COROUTINE | inspect.CO_ASYNC_GENERATOR)
    return not runs_later and any("_IF_" in instruction.opname for instruction in dis.get_instructions(code))


def _identities(value) -> Iterator[int]:
    """What tells whether a value was changed: of collections, arrays and objects their entries."""
    yield id(value)
    if isinstance(value, Number | type | types.FunctionType):
        return
    parts = value.values() if isinstance(value, dict) else value if isinstance(value, list | tuple) else ()
    if isinstance(value, np.ndarray):
        parts = value.ravel().tolist() if value.dtype == object else ()
        yield hash(value.tobytes()) if value.dtype != object else 0
    for part in (*parts, *getattr(value, "__dict__", {}).values()):
        yield from _identities(part)


def _numbers_in(value) -> Iterator[Number]:
    """The Numbers in a value, or in nested tuples, lists and arrays."""
    if isinstance(value, Number):
        yield value
    elif isinstance(value, (tuple, list)) or isinstance(value, np.ndarray) and value.dtype == object:
        for entry in value:
            yield from _numbers_in(entry)
