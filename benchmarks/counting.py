"""Counts of operations: a computation's source is run on numbers that record their operands.

Each number knows the operation and the operands that it was made of. Counted are those operations on which a
result depends, each once, however often the source writes it: what a compiler drops, or finds twice, is no work.
Operations on constants alone are done before, and count nothing; so do comparisons, signs, roundings and masks.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from unittest import mock

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin

from thruster_env.core.compiled import interpreted

ADD, MULTIPLY, DIVIDE, ROOT, RECIPROCAL_ROOT = "add", "multiply", "divide", "root", "reciprocal root"
PRODUCT, INTEGER = "integer product", "integer"  # of 32 bits by 32, and shifts, sums and exclusive ors

KINDS = {  # of operations; None for those that are free beside others, and for the mathematical library's
    **dict.fromkeys(("add", "subtract"), ADD),
    **{"multiply": MULTIPLY, "square": MULTIPLY, "divide": DIVIDE, "sqrt": ROOT},
    **dict.fromkeys(("right_shift", "left_shift", "bitwise_xor", "bitwise_or"), INTEGER),
    **dict.fromkeys(("absolute", "negative", "positive", "bitwise_and", "minimum", "maximum")),
    **dict.fromkeys(("floor", "ceil", "rint", "remainder")),
    **dict.fromkeys(("sin", "cos", "tan", "arctan2", "exp", "log")),
}
COMPARISONS = "less", "less_equal", "greater", "greater_equal", "equal", "not_equal"
COMMUTATIVE = "add", "multiply", "bitwise_xor", "bitwise_or"
NEUTRAL = {"add": 0.0, "multiply": 1.0}  # operands that change nothing
POWERS = {0.5: ROOT, -0.5: RECIPROCAL_ROOT, 2: MULTIPLY}


class Counted(NDArrayOperatorsMixin):
    """A number and the operation that computed it."""

    __slots__ = ("graph", "kind", "operands", "value")

    def __init__(self, graph: Graph, value, kind: str | None, operands: tuple[Counted, ...]):
        self.graph, self.value, self.kind, self.operands = graph, value, kind, operands

    def __array_ufunc__(self, ufunc, method, *inputs, out=None):
        if any(isinstance(x, np.ndarray) and x.ndim for x in inputs):
            return ufunc(*(x if isinstance(x, np.ndarray) else _entry(x) for x in inputs))
        name, value = ufunc.__name__, ufunc(*(x.value if isinstance(x, Counted) else x for x in inputs))
        if name in COMPARISONS:
            return value
        for x, other in (inputs, inputs[::-1]) if name in NEUTRAL else ():
            if not isinstance(other, Counted) and other == NEUTRAL[name]:
                return x
        return self.graph.number(name, inputs, value, _kind(name, inputs, value))

    def __float__(self) -> float:
        """For functions of the mathematical library; their result counts as a constant."""
        self.graph.results.append(self)
        return float(self.value)

    def __int__(self) -> int:
        """For places in arrays and numbers of rounds."""
        self.graph.results.append(self)
        return int(self.value)

    def view(self, kind: _Converter) -> Counted:
        """The same bits as a number of another type."""
        return self.graph.number(f"as {kind.type.__name__}", (self,), self.value.view(kind.type), None)


def _method(name: str) -> Callable:
    return lambda self: getattr(np, name)(self)


for _name in ("sqrt", "sin", "cos", "tan", "exp", "log", "floor", "ceil"):  # NumPy asks entries of arrays for them
    setattr(Counted, _name, _method(_name))


def _entry(x) -> np.ndarray:
    """A number as an array without axes, so that NumPy takes it for one beside an array's entries."""
    out = np.array(None)
    out[()] = x
    return out


class Graph:
    """All numbers of one computation."""

    def __init__(self):
        self._known: dict[tuple, Counted] = {}
        self._variables: list[Counted] = []
        self.results: list[Counted] = []

    def variables(self, array: np.ndarray) -> np.ndarray:
        """An array as variables: numbers that are inputs, not constants."""
        out = array.astype(object)
        for index, value in np.ndenumerate(array):
            out[index] = Counted(self, value, None, ())
        self._variables += out.ravel().tolist()
        return out

    def number(self, name: str, inputs: tuple, value, kind: str | None) -> Counted:
        """The result of an operation; the same operation on the same operands gives the same object."""
        names = [id(x) if isinstance(x, Counted) else (x,) for x in inputs]
        key = (name, *(sorted(names, key=str) if name in COMMUTATIVE else names))
        if key not in self._known:
            operands = tuple(x for x in inputs if isinstance(x, Counted))
            if kind == DIVIDE and len(operands) == 1 and operands[0].kind == ROOT:
                kind, operands = RECIPROCAL_ROOT, operands[0].operands
            self._known[key] = Counted(self, value, kind, operands)
        return self._known[key]

    def operations(self, *arrays: np.ndarray) -> Counter[str]:
        """Number of operations of each kind on which the numbers in arrays depend."""
        numbers = [x for array in arrays for x in array.ravel().tolist() if isinstance(x, Counted)]
        waiting = {id(x): x for x in numbers + self.results}
        visited, count = set(waiting), Counter()
        while waiting:
            _, number = waiting.popitem()
            if number.kind is not None:
                count[number.kind] += 1
            waiting |= {id(x): x for x in number.operands if id(x) not in visited}
            visited |= {id(x) for x in number.operands}
        return count


def _kind(name: str, inputs: tuple, value) -> str | None:
    if name == "divide" and not isinstance(inputs[1], Counted):
        return MULTIPLY  # by the reciprocal of a constant
    if name == "power" and inputs[1] in POWERS:
        return POWERS[inputs[1]]
    if name not in KINDS:
        raise TypeError(f"operations that are counted must be among {', '.join(KINDS)}, but got {name}")
    if isinstance(value, int | np.integer):
        return {ADD: INTEGER, MULTIPLY: PRODUCT}.get(KINDS[name], KINDS[name])
    return KINDS[name]


class _Converter:
    """One of NumPy's types of numbers, which lets a counted number remain one."""

    def __init__(self, kind: type):
        self.type = kind

    def __call__(self, x):
        if not isinstance(x, Counted):
            return self.type(x)
        return x.graph.number(self.type.__name__, (x,), self.type(x.value), None)


def _zeros(shape, *_: Any) -> np.ndarray:
    return np.full(shape, 0.0, dtype=object)


@contextmanager
def counting() -> Iterator[Graph]:
    """Within this context sources run as Python, on numbers of a new graph, also in arrays that they make."""
    patched = {name: _Converter(getattr(np, name)) for name in ("float64", "int64", "uint64")}
    with interpreted(), mock.patch.multiple(np, empty=_zeros, zeros=_zeros, **patched):
        yield Graph()


def operations_of(function: Callable, *arguments) -> Counter[str]:
    """Operations of a function of vectors (tuples) that returns one; arguments that are arrays are variables."""
    with counting() as graph:
        operands = (tuple(graph.variables(a)) if isinstance(a, np.ndarray) else a for a in arguments)
        return graph.operations(np.array(function(*operands), dtype=object))
