"""Functions of a model that run as Python: called with Python's floats, they have the values of machine code.

NumPy's scalars are not what a user wrote for: (x > 0) + (y > 0) is at most 1 of them, `case True` matches none of
their truth values, and x/abs(x) is NaN where Python raises what the function may catch. Python's floats raise
where machine code has infinity or NaN. So a function is called with Python's floats first. If it raises, or
returns complex numbers, a copy of it is called with floats whose arithmetic is that of IEEE 754.
"""

from __future__ import annotations

import contextlib
import functools
import math
import sys
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from thruster_env.core.compiled import compiled_in_place_of, inlined, rounds
from thruster_env.core.equal_functions import makes_functions
from thruster_env.core.user_functions import (
    Copies,
    Module,
    caught,
    functions_in,
    inverts,
    needs_python,
    stand_in,
    takes_roots,
)
from thruster_env.graphs.tracing import OTHER_NAMES
from thruster_env.graphs.written_functions import written_function

WITHOUT_VALUE = ArithmeticError, ValueError, TypeError  # of 1/0, of sqrt(-1), of complex numbers that are compared


class _OfFloats(type):
    def __instancecheck__(cls, value) -> bool:
        return isinstance(value, float)


class Float(float, metaclass=_OfFloats):
    """A float whose quotients, powers and rests have a value where NumPy's have, unless exceptions are caught."""

    __slots__ = ()

    def __floor__(self):
        """A whole number; of what is not finite itself."""
        return math.floor(float(self)) if math.isfinite(self) else self

    def __ceil__(self):
        """A whole number; of what is not finite itself."""
        return math.ceil(float(self)) if math.isfinite(self) else self

    def __trunc__(self):
        """A whole number; of what is not finite itself."""
        return math.trunc(float(self)) if math.isfinite(self) else self

    def __round__(self, digits=None):
        """A rounded number; of what is not finite itself."""
        return _plain(round(float(self), digits)) if math.isfinite(self) else self


def _method(name: str) -> Callable:
    of_python, of_numpy = getattr(float, name), getattr(np.float64, name)

    def method(self, *others):
        try:
            found = of_python(self, *others)
        except ArithmeticError:
            if _is_caught():
                raise
            return _plain(of_numpy(np.float64(self), *others))
        if type(found) is float:
            return Float(found)
        return _plain(of_numpy(np.float64(self), *others) if isinstance(found, complex) else found)

    return method


for _name in "add sub mul truediv floordiv mod divmod pow".split():
    for _side in ("", "r"):
        setattr(Float, f"__{_side}{_name}__", _method(f"__{_side}{_name}__"))
for _name in "neg pos abs".split():
    setattr(Float, f"__{_name}__", _method(f"__{_name}__"))


def _plain(found: Any) -> Any:
    """A result with Floats in place of floats, and Python's truth values in place of NumPy's."""
    if isinstance(found, np.generic):
        found = found.item()
    if type(found) is tuple:
        return tuple(map(_plain, found))
    return Float(found) if type(found) is float else found


def _is_caught() -> bool:
    """Whether the user's code that is running catches exceptions where it is."""
    frame = sys._getframe(2)
    while frame is not None and frame.f_code is not _by_ieee.__code__:
        if any(first <= frame.f_lasti < end for first, end in caught(frame.f_code)):
            return True
        frame = frame.f_back  # type: ignore[assignment]
    return False


@functools.cache
def _in_place_of(module, name: str) -> Any:
    """What a copy finds under a name in `math` or NumPy: functions of the latter in place of what raises."""
    function = getattr(module, name)
    if function is np.linalg:
        return Module(np.linalg, _in_place_of)
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
    return Copies(_in_place_of, {"float": Float}).called(function)


class Floats(np.ndarray):
    """An array of float64 whose entries are Python's numbers.

    Attributes:
        kind: of the floats.
    """

    kind: Callable = float

    def __array_finalize__(self, other):
        """Parts and results have the same entries."""
        self.kind = getattr(other, "kind", float)

    def __getitem__(self, place):
        """An entry as a number of Python, or a part of the array."""
        found = super().__getitem__(place)
        return self._entry(found) if isinstance(found, np.generic) else found

    def __iter__(self):
        """Entries, or rows."""
        return map(self.__getitem__, range(len(self)))

    def __array_wrap__(self, array, context=None, return_scalar=False):
        """A single result is a number of Python."""
        return self._entry(array[()]) if return_scalar else super().__array_wrap__(array, context, return_scalar)

    def _entry(self, value: np.generic) -> Any:
        plain = value.item()
        return self.kind(plain) if type(plain) is float else plain


def with_floats(kind: Callable, arguments: Sequence) -> list:
    """Arguments of a function with floats of a kind in the places of floats; others as they are."""
    found: list = []
    for one in arguments:
        if isinstance(one, tuple):
            parts = [kind(part) if isinstance(part, float) else part for part in one]
            found.append(type(one)(*parts) if hasattr(one, "_fields") else tuple(parts))
        elif type(one) is np.ndarray and one.dtype == np.float64 and kind is not np.float64:
            found.append(one.view(Floats))
            found[-1].kind = kind
        else:
            found.append(one)
    return found


def _is_real(value: Any) -> bool:
    """Whether a number, or all of a vector or matrix, is not complex."""
    if isinstance(value, np.ndarray):
        return value.dtype.kind != "c"
    return all(map(_is_real, value)) if isinstance(value, (tuple, list)) else not isinstance(value, complex)


def _by_ieee(function: Callable, arguments: tuple) -> Any:
    return _copy(function)(*with_floats(Float, arguments))


@makes_functions
def with_python_floats(function: Callable, arguments: str = "", sizes=(), form=0, shape=()) -> Callable:
    """Return a function that calls another one with Python's floats, and is the other one where it is compiled.

    Where that raises what floats alone raise (1/0 is infinite in machine code, sqrt(-1) NaN), or returns complex
    numbers, it has the value of IEEE 754, but for what the function catches. A function with a `~` gets NumPy's
    scalars, of whose truth values it is the contrary, as in machine code; one with roots gets floats of IEEE 754
    at once, as Python's root of a negative number is complex.

    If its arguments are named, with what `written_function` takes, compiled functions have what numba refuses from
    its graph.
    """
    written = written_function(function, arguments, sizes, form, shape) if arguments else None
    inlined(function)
    codes = [one.__code__ for one in functions_in(function)]
    kind = np.float64 if any(map(inverts, codes)) else Float if any(map(takes_roots, codes)) else float

    def called(*arguments):
        written  # noqa: B018 - part of the key of machine code
        failure: Exception = TypeError("a function of a model must return real numbers")
        try:
            found = function(*with_floats(kind, arguments))
            if _is_real(found):
                return found
        except WITHOUT_VALUE as error:
            failure = error
            if not any(isinstance(one, float) for one in arguments[0][:1]):  # Numbers or tensors
                raise
        with np.errstate(all="ignore"):
            for other in (_by_ieee, _by_numpy):
                with contextlib.suppress(*WITHOUT_VALUE):
                    return other(function, arguments)
        raise failure

    called.__name__, called.__module__ = (getattr(function, name, "") for name in ("__name__", "__module__"))
    if written is None:
        return compiled_in_place_of(called, function)
    return stand_in(compiled_in_place_of(called, written, rounded_as=function), function)


def _by_numpy(function: Callable, arguments: tuple) -> Any:
    """What a function makes of NumPy's scalars, of which 1/(x > 0) has a value; rests of conditions are wrong."""
    if needs_python(function) or any(rounds(one.__code__) for one in functions_in(function)):
        raise TypeError
    return function(*with_floats(np.float64, arguments))
