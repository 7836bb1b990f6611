"""Symbols that stand for numbers, and the functions of `math` and numpy on them, as MATLAB writes them."""

from __future__ import annotations

import builtins
import math
import types
from collections.abc import Callable, Sequence
from functools import partial, reduce
from typing import Any

import numpy as np

ONE = {  # functions of one number: names in `math` and numpy, and what MATLAB has for them
    **{name: f"{name}({{}})" for name in ("sin", "cos", "tan", "sinh", "cosh", "tanh", "exp", "expm1", "log1p")},
    **{name: f"{name}({{}})" for name in ("log2", "log10", "sqrt", "floor", "ceil", "sign", "erf", "erfc")},
    **{f"arc{name}": f"a{name}({{}})" for name in ("sin", "cos", "tan", "sinh", "cosh", "tanh")},
    **{f"a{name}": f"a{name}({{}})" for name in ("sin", "cos", "tan", "sinh", "cosh", "tanh")},
    "log": "log({})",
    "gamma": "gamma({})",
    "abs": "abs({})",
    "absolute": "abs({})",
    "fabs": "abs({})",
    "trunc": "fix({})",
    "fix": "fix({})",
    "cbrt": "nthroot({}, 3)",
    "exp2": "2 ^ {}",
    "square": "{0} * {0}",
    "reciprocal": "1 / {}",
    "lgamma": "gammaln({})",
    **{name: "{} * pi / 180" for name in ("radians", "deg2rad")},
    **{name: "{} * 180 / pi" for name in ("degrees", "rad2deg")},
}
TWO = {  # of two
    **{name: "atan2({}, {})" for name in ("atan2", "arctan2")},
    **{name: "{} ^ {}" for name in ("pow", "power")},
    **{name: "min({}, {})" for name in ("minimum", "fmin")},
    **{name: "max({}, {})" for name in ("maximum", "fmax")},
    "hypot": "hypot({}, {})",
    "fmod": "rem({}, {})",
    "remainder": "{0} - {1} * round({0} / {1})",  # that of `math`; numpy's is `mod`
    "mod": "mod({}, {})",
    "copysign": "abs({0}) * (2 * ({1} >= 0) - 1)",
}
MODULES = (math, np)


class Branch(TypeError):
    """A symbol is asked for its value."""


class Tape:
    """Operations in their order, none of them twice."""

    def __init__(self):
        """Nothing is on it yet."""
        self._places: dict[str, str] = {}
        self._used: dict[str, tuple[str, ...]] = {}

    def note(self, expression: str, *parts: str) -> Symbol:
        """The symbol of an operation on some parts."""
        name = self._places.setdefault(expression, f"t{len(self._places) + 1}")
        self._used[name] = parts
        return Symbol(self, name)

    def lines(self, results: Sequence[str]) -> list[tuple[str, str]]:
        """Names and expressions of what some results need, in the order of computing."""
        needed, rest = set(), list(results)
        while rest:
            name = rest.pop()
            if name in self._used and name not in needed:
                needed.add(name)
                rest += self._used[name]
        return [(name, expression) for expression, name in self._places.items() if name in needed]


def _both(form: str) -> tuple[Callable, Callable]:
    """An operator with a symbol on its left, and with one on its right."""

    def note(tape: Tape, first: Any, second: Any) -> Symbol:
        a, b = text(first), text(second)
        return tape.note(form.format(a, b), a, b)

    return lambda self, other: note(self.tape, self, other), lambda self, other: note(self.tape, other, self)


def _compared(self, other: Any) -> bool:
    """Nobody knows."""
    raise Branch("compares a value")


class Symbol:
    """What stands for a number."""

    __hash__ = None  # type: ignore[assignment]  # equality is not known either

    def __init__(self, tape: Tape, name: str):
        """A symbol of a name on a tape."""
        self.tape, self.name = tape, name

    __add__, __radd__ = _both("{} + {}")
    __sub__, __rsub__ = _both("{} - {}")
    __mul__, __rmul__ = _both("{} * {}")
    __truediv__, __rtruediv__ = _both("{} / {}")
    __pow__, __rpow__ = _both("{} ^ {}")
    __mod__, __rmod__ = _both("mod({}, {})")  # of the sign of the divisor, as Python's
    __floordiv__, __rfloordiv__ = _both("floor({} / {})")
    __lt__ = __le__ = __gt__ = __ge__ = __eq__ = __ne__ = _compared

    def __neg__(self) -> Symbol:
        """Minus a symbol."""
        return self.tape.note(f"-{self.name}", self.name)

    def __pos__(self) -> Symbol:
        """The symbol itself."""
        return self

    def __abs__(self) -> Symbol:
        """Absolute value of a symbol."""
        return self.tape.note(f"abs({self.name})", self.name)

    def __bool__(self) -> bool:
        """Nobody knows."""
        raise Branch("asks whether a value is true")

    def __getattr__(self, name: str) -> Callable:
        """What numpy's functions call on objects."""
        if name not in ONE and name not in TWO:
            raise AttributeError(name)
        return partial(applied, name, self)


def text(value: Any) -> str:
    """A symbol's name, or a number as it is written in a product."""
    if isinstance(value, Symbol):
        return value.name
    number = float(value)
    return f"{number:.17g}" if number >= 0 else f"({number:.17g})"


def applied(name: str, *given: Any) -> Symbol:
    """A function of `ONE` or `TWO` on what are not all numbers."""
    form, count = (ONE[name], 1) if name in ONE and len(given) == 1 else (TWO.get(name, ""), 2)
    if not form or len(given) != count:
        raise TypeError(f"calls {name} with {len(given)} values")
    parts = [text(one) for one in given]
    tape = next(one.tape for one in given if isinstance(one, Symbol))
    return tape.note(form.format(*parts), *parts)


def _stands_in(name: str, function: Callable) -> Callable:
    """A function of numbers that also takes symbols."""

    def call(*given: Any) -> Any:
        if not any(isinstance(one, Symbol) for one in given):
            return function(*given)
        if name == "log" and len(given) == 2:
            return applied("log", given[0]) / call(given[1])
        if name == "clip":
            return applied("minimum", applied("maximum", given[0], given[1]), given[2])
        return applied(name, *given)

    return call


def _least(name: str, function: Callable) -> Callable:
    """`min` or `max` of any numbers, or of a sequence, also of symbols."""

    def call(*given: Any) -> Any:
        some = tuple(given[0]) if len(given) == 1 else given
        if not any(isinstance(one, Symbol) for one in some):
            return function(some)
        return reduce(lambda a, b: _stands_in(name, function)(a, b), some)

    return call


class _Module:
    """A module whose elementary functions take symbols."""

    def __init__(self, module: types.ModuleType):
        """Take the module."""
        self._module = module

    def __getattr__(self, name: str) -> Any:
        """A function that takes symbols if there is one, otherwise the module's."""
        return on_symbols(getattr(self._module, name))


def on_symbols(value: Any) -> Any:
    """What stands in for a value of a function's surroundings while it is run on symbols; else the value."""
    if any(value is module for module in MODULES):
        return _Module(value)
    if value is builtins.min or value is builtins.max:
        return _least("minimum" if value is builtins.min else "maximum", value)
    name = "mod" if value is np.remainder else getattr(value, "__name__", "")
    if callable(value) and (name in ONE or name in TWO or name == "clip"):
        if any(getattr(module, name, None) is value for module in MODULES):
            return _stands_in(name, value)
    return value
