"""A plain function of floats, called with Numbers: what it computes becomes a graph, if it never decides.

A user's function knows nothing of Numbers. It says `math.sin(x)`, which wants a float, or `max(x, 0.0)`, which
decides. So a copy of it is made that finds our own functions under these names, and so are copies of all
functions that it calls:

    traced(lambda x: max(math.sin(x[0]), 0.0))((number,))

A function that decides for itself (`if x > 0.0`, `while error > 1e-9`), looks a number up in a table or hands
it to something that wants a float raises TypeError on the way: it cannot be traced, and has to be called as it
is.
"""

from __future__ import annotations

import builtins
import math
import types
from collections.abc import Callable
from typing import Any

import numpy as np

from thruster_env.numerics.algebra.graphs import UNARY, Number, arctan2, where

OTHER_NAMES = {
    "atan": "arctan",
    "atan2": "arctan2",
    "fabs": "absolute",
    "abs": "absolute",
    "pow": "power",
}
"""NumPy's names of functions of `math`."""


def _of_number(name: str) -> Callable:
    def function(x):
        if isinstance(x, np.ndarray) and x.dtype == object:
            return np.array([function(one) for one in x.ravel()], dtype=object).reshape(x.shape)
        return getattr(x, name)() if isinstance(x, Number) else getattr(np, name)(x)

    return function


def _largest(*numbers):
    found, *others = numbers[0] if len(numbers) == 1 else numbers
    for one in others:
        found = where(one > found, one, found)
    return found


def _smallest(*numbers):
    found, *others = numbers[0] if len(numbers) == 1 else numbers
    for one in others:
        found = where(one < found, one, found)
    return found


def _filled(value: float) -> Callable:
    """In place of NumPy's zeros and ones: an array that Numbers may be written to."""
    return lambda shape, *_, **__: np.full(shape, value, dtype=object)


FUNCTIONS: dict[str, Callable] = {
    **{name: _of_number(name) for name in UNARY},
    "absolute": abs,
    "power": lambda x, e: x**e,
    "square": lambda x: x * x,
    "hypot": lambda x, y: (x * x + y * y) ** 0.5,
    "sign": lambda x: where(x > 0.0, 1.0, where(x < 0.0, -1.0, 0.0)),
    "where": where,
    "arctan2": arctan2,
    "maximum": _largest,
    "minimum": _smallest,
    "zeros": _filled(0.0),
    "empty": _filled(0.0),
    "ones": _filled(1.0),
    "float64": lambda x: x,
}
"""In place of functions of `math` and NumPy, by NumPy's names."""

BUILTINS = {
    "max": _largest,
    "min": _smallest,
    "float": lambda x: x if isinstance(x, Number) else float(x),
    "pow": pow,
}


class _Module:
    """A module whose functions take Numbers, where there is one of ours."""

    def __init__(self, module: types.ModuleType):
        self._module = module

    def __getattr__(self, name: str):
        return FUNCTIONS.get(OTHER_NAMES.get(name, name)) or getattr(self._module, name)


def traced(function: Callable) -> Callable:
    """A copy of a function that takes Numbers; it raises TypeError where they do not do for floats."""
    return _traced(function, {})


def _traced(value: Any, copies: dict[int, Any]) -> Any:
    """A value that a function finds under a name, as its copy shall find it."""
    if isinstance(value, types.ModuleType) and value in (math, np):
        return _Module(value)
    function = getattr(value, "py_func", value)  # of a function compiled by numba
    if not isinstance(function, types.FunctionType):
        name = getattr(value, "__name__", "")
        ours = callable(value) and (value is getattr(math, name, None) or value is getattr(np, name, None))
        return FUNCTIONS.get(OTHER_NAMES.get(name, name), value) if ours else value
    if id(function) not in copies:
        cells = tuple(types.CellType() for _ in function.__closure__ or ())
        names = vars(builtins) | BUILTINS | {"__builtins__": builtins}  # which what NumPy imports late asks for
        copy = types.FunctionType(function.__code__, names, function.__name__, function.__defaults__, cells)
        copy.__kwdefaults__ = function.__kwdefaults__
        copies[id(function)] = copy
        names |= {name: _traced(function.__globals__[name], copies) for name in _names(function)}
        for cell, old in zip(cells, function.__closure__ or (), strict=True):
            cell.cell_contents = _traced(old.cell_contents, copies)
    return copies[id(function)]


def _names(function: types.FunctionType) -> list[str]:
    """The global names of a function, and of those defined within it."""
    waiting, found = [function.__code__], []
    while waiting:
        code = waiting.pop()
        found += [name for name in code.co_names if name in function.__globals__]
        waiting += [one for one in code.co_consts if isinstance(one, types.CodeType)]
    return found
