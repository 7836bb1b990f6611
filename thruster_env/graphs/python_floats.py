"""Functions of a model that run as Python: called with Python's floats, they have the values of machine code.

With NumPy's scalars a user's function may differ: (x > 0) + (y > 0) is at most 1, `case True` never matches, and
x/abs(x) is NaN where Python raises an exception that the function may catch. Python's floats raise where machine
code has infinity or NaN. So the function is called with Python's floats first. If it raises or returns complex
numbers, a copy of it is called with floats that follow IEEE 754.
"""

from __future__ import annotations

import contextlib
import functools
import math
import sys
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from thruster_env.core.compiled import (
    Copies,
    Module,
    caught,
    functions_in,
    inverts,
    needs_python,
    rounds,
    takes_roots,
)
from thruster_env.graphs.tracing import OTHER_NAMES

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
    return Copies(_replacement, {"float": Float}).of(function)


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


def _call_with_ieee(function: Callable, arguments: Sequence) -> Any:
    return _copy(function)(*with_floats(Float, arguments))


def in_python(function: Callable, arguments: Sequence) -> Any:
    """The result of a function for Python's floats.

    If the function raises an exception that only Python's floats raise (1/0 is infinite in machine code, sqrt(-1)
    NaN), or returns complex numbers, the result follows IEEE 754, except for exceptions that the function catches.
    A function with a `~` gets NumPy's scalars, for which `~` negates truth values as in machine code. A function
    with roots gets floats of IEEE 754 at once, because Python's root of a negative number is complex.
    """
    failure: Exception = TypeError("a function of a model must return real numbers")
    try:
        result = function(*with_floats(_kind_for(function), arguments))
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


@functools.lru_cache(maxsize=128)
def _kind_for(function: Callable) -> type[float]:
    codes = [part.__code__ for part in functions_in(function)]
    return np.float64 if any(map(inverts, codes)) else Float if any(map(takes_roots, codes)) else float


def _call_with_numpy(function: Callable, arguments: Sequence) -> Any:
    """The result for NumPy's scalars, for which 1/(x > 0) has a value; their `%` of conditions is wrong."""
    if needs_python(function) or any(rounds(part.__code__) for part in functions_in(function)):
        raise TypeError
    return function(*with_floats(np.float64, arguments))
