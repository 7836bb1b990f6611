"""A function of a model as lines of another language, found by running it on symbols instead of numbers.

It takes functions made of + - * / % abs ** and numpy's elementary functions, as those of the thruster and of the
vehicle are; one that branches, or calls `math`, cannot be traced.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

FUNCTIONS = {  # numpy's names: those of MATLAB and of Python's math
    "sin": "sin",
    "cos": "cos",
    "tan": "tan",
    "arctan": "atan",
    "sinh": "sinh",
    "cosh": "cosh",
    "tanh": "tanh",
    "exp": "exp",
    "log": "log",
    "sqrt": "sqrt",
}


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


def _both(sign: str) -> tuple[Callable, Callable]:
    """An operator with a symbol on its left, and with one on its right."""

    def note(tape: Tape, first: Any, second: Any) -> Symbol:
        a, b = _text(first), _text(second)
        return tape.note(f"{a} {sign} {b}", a, b)

    return lambda self, other: note(self.tape, self, other), lambda self, other: note(self.tape, other, self)


class Symbol:
    """What stands for a number."""

    def __init__(self, tape: Tape, name: str):
        """A symbol of a name on a tape."""
        self.tape, self.name = tape, name

    __add__, __radd__ = _both("+")
    __sub__, __rsub__ = _both("-")
    __mul__, __rmul__ = _both("*")
    __truediv__, __rtruediv__ = _both("/")
    __pow__, __rpow__ = _both("^")

    def __mod__(self, other: Any) -> Symbol:
        """Remainder, of the sign of the divisor."""
        return self.tape.note(f"mod({self.name}, {_text(other)})", self.name, _text(other))

    def __neg__(self) -> Symbol:
        """Minus a symbol."""
        return self.tape.note(f"-{self.name}", self.name)

    def __abs__(self) -> Symbol:
        """Absolute value of a symbol."""
        return self.tape.note(f"abs({self.name})", self.name)

    def __bool__(self) -> bool:
        """Nobody knows."""
        raise TypeError("a symbol is neither true nor false")

    def __getattr__(self, name: str) -> Callable[[], Symbol]:
        """What numpy's functions call on objects."""
        if name not in FUNCTIONS:
            raise AttributeError(name)
        return lambda: self.tape.note(f"{FUNCTIONS[name]}({self.name})", self.name)


def traced(function: Callable, arguments: Sequence[Sequence[str]], constants: Any) -> list[str] | None:
    """Lines "t1 = a + b;" of a function and, last, "[t7; t9]", its results; None if it cannot be traced.

    Args:
        function: of a model, which takes tuples of components and the constants last.
        arguments: names of the components of each tuple.
        constants: of the model.
    """
    tape = Tape()
    try:
        found = function(*(tuple(Symbol(tape, name) for name in names) for names in arguments), constants)
        results = [_text(one) for one in found]
    except (TypeError, AttributeError, ValueError):
        return None
    return [*(f"{name} = {told};" for name, told in tape.lines(results)), f"[{'; '.join(results)}]"]


def _text(value: Any) -> str:
    """A symbol's name, or a number as it is written in a product."""
    if isinstance(value, Symbol):
        return value.name
    number = float(value)
    return f"{number:.17g}" if number >= 0 else f"({number:.17g})"
