"""Nested values of numbers, such as a plant's memory: their leaves, their shape, functions of them.

A value is a number, None, or a tuple, named tuple or dictionary of values. Two values of one shape differ in their
numbers alone, so that one program serves both.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator
from functools import lru_cache
from itertools import count as count_from
from typing import Any

import numpy as np

from thruster_env.core.compiled import function_fingerprint
from thruster_env.graphs.branches import on_every_side
from thruster_env.graphs.graphs import Number, called, where
from thruster_env.graphs.programs import CALLED, READ_NUMBERS
from thruster_env.graphs.tracing import traced

NUMBER, TABLE = "number", "table"  # shapes of a leaf


class Line:
    """Values on their way, as those of a delayed sensor: each comes out `size` steps after it has gone in.

    Before `size` steps are over, the first one comes out. `push` is called once in each step.

    Args:
        size: of the line, in steps; at least 1.
        first: the value of the first step.
    """

    def __init__(self, size: int, first: Any, last: Any = None, oldest: Any = None):
        """See the class; `last` is what went in last, `oldest` what comes out next."""
        self.size, self.first = size, first
        self.last, self.oldest = (first if value is None else value for value in (last, oldest))

    def push(self, value: Any) -> tuple[Any, Line]:
        """What comes out as a value goes in, and the line after it."""
        return self.oldest, Line(self.size, self.first, value)


class Table:
    """A row of `count` numbers that are known at run time, from a place `first` of the array `numbers` on."""

    def __init__(self, first: Number, count: Number):
        """See the class."""
        self.first, self.count = first, count

    def __getitem__(self, index: Number) -> Number:
        """The number at an index, a whole number from 0 to count - 1."""
        last = self.count - 1.0
        index = where(index > 0.0, where(index < last, index, last), 0.0)
        return self.first.graph.make("table", self.first + index)

    def call(self, work: Callable, count: int, *numbers: Any) -> list[Number]:
        """The `count` results of work(arguments, results, numbers), compiled as it is and called for each copy.

        Its arguments are the table's place in `numbers` and the numbers given here.
        """
        name = base = f"{work.__name__}_{function_fingerprint(work)[:24]}"
        versions = count_from(1)  # functions of equal code may hold different objects
        while CALLED.setdefault(name, work) is not work:
            name = f"{base}_{next(versions)}"
        READ_NUMBERS.add(name)
        return called(name, count, self.first, *map(self.first.graph.number, numbers))


def _of_objects(value: Any) -> bool:
    return isinstance(value, np.ndarray) and value.dtype == object


def leaves(value: Any) -> list:
    """The numbers of a value, in order."""
    if _of_objects(value):
        return leaves(value.ravel().tolist())
    if isinstance(value, dict):
        return [leaf for part in value.values() for leaf in leaves(part)]
    if isinstance(value, (tuple, list)):
        return [leaf for part in value for leaf in leaves(part)]
    if isinstance(value, Line):
        return leaves((value.first, value.last))
    return [] if value is None else [value]


def shape_of(value: Any) -> Hashable:
    """The shape of a value: values of equal shapes differ in their numbers alone."""
    if isinstance(value, dict):
        return dict, tuple(value), tuple(map(shape_of, value.values()))
    if isinstance(value, (tuple, list)):
        return type(value) if hasattr(value, "_fields") else tuple, tuple(map(shape_of, value))
    if isinstance(value, Line):
        return Line, value.size, shape_of(value.first)
    if isinstance(value, (np.ndarray, Table)):
        return TABLE
    return None if value is None else NUMBER


def built(shape: Any, numbers: Iterator, line: Callable[[Line], Line] = lambda line: line) -> Any:
    """The value of a shape that has these numbers; a table takes two, its place and its length.

    `line`, if given, says what comes out of each line.
    """
    if shape is None:
        return None
    if shape == NUMBER:
        return next(numbers)
    if shape == TABLE:
        return Table(next(numbers), next(numbers))
    kind, *_, parts = shape
    if kind is Line:
        _, size, part = shape
        return line(Line(size, built(part, numbers, line), built(part, numbers, line)))
    values = [built(part, numbers, line) for part in parts]
    if kind is dict:
        return dict(zip(shape[1], values, strict=True))
    return kind(*values) if hasattr(kind, "_fields") else tuple(values)


def _name(function: Callable) -> str:
    return getattr(function, "__qualname__", repr(function))


@lru_cache(maxsize=256)
def traceable(function: Callable, *, may_raise: bool = True) -> Callable:
    """A user's function of values that takes Numbers, too, and may decide by them.

    Machine code rounds it as Python does, whatever is done with its arguments before. A branch that raises an
    exception has NaN.

    Raises:
        TypeError: if Numbers cannot replace floats in it, from `tracing.traced` or a call; if two calls differ; or
            if a branch raises an exception, unless it `may_raise`.
    """
    copy = traced(function)

    def call(*arguments):
        numbers = [leaf for leaf in leaves(arguments) if isinstance(leaf, Number)]
        if not numbers:
            return copy(*arguments)
        graph, shapes = numbers[0].graph, []
        graph.whole.update(number.place for number in numbers)

        def entries() -> np.ndarray:
            result = copy(*arguments)
            result = tuple(result.ravel().tolist()) if isinstance(result, np.ndarray) else result
            shapes.append(shape_of(result))
            entries = np.empty(len(leaves(result)), dtype=object)
            entries[:] = [graph.number(leaf) for leaf in leaves(result)]
            return entries

        outside = graph.may_raise
        graph.may_raise = outside and may_raise
        try:
            results, again = on_every_side(entries, graph), on_every_side(entries, graph)
        finally:
            graph.may_raise = outside
        if any(a is not b for a, b in zip(results, again, strict=False)):
            raise TypeError(
                f"{_name(function)} must depend on its arguments alone, but two calls returned different values: "
                "t.normals() and t.uniforms() of an effect draw numbers"
            )
        if any(shape != shapes[0] for shape in shapes):
            raise TypeError("results of a traced function must have one shape in all its branches")
        return built(shapes[0], iter(results))

    return call
