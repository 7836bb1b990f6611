"""Graphs of matrices as calls of functions that are made for their sizes: for models of any size, and of any kind.

Where a model's functions cannot be traced, or the graph of all numbers would be too large, each operation on
matrices is a line that calls the function for these sizes (`thruster_env.core.matrices`): tuples in registers,
or loops over arrays.

    v2 = work2(v0, v1)
    store(rows, v2)

What is done with each member of an ensemble by itself stands in a loop, as much of it as the order allows.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from math import prod
from typing import Any

import numpy as np

from filters.algebra import members_called, operations
from filters.algebra.matrices import Matrix, Operation, in_order
from filters.algebra.matrices_called import arguments_of, function_of
from thruster_env.core.sources import is_array, matrix_of, tuple_of, written_out
from thruster_env.graphs.programs import ARRAYS, Place


def calls_of(
    stores: Sequence[tuple[Place, Matrix]],
    known: Mapping[Matrix, Place | Callable],
    functions: Mapping[Operation, Callable],
    arrays: Sequence[str] = ARRAYS,
) -> Callable:
    """`work(*arrays)`, which makes some stores for one run; compiled functions may call it.

    Args:
        stores: what is to be stored, and from where on.
        known: of each matrix that is given where it begins, or a function of `numbers` that reads it.
        functions: what works out operations that are not ours, those of a model.
        arrays: names of the arguments.
    """
    text, last = _Text(known, functions), [one for _, one in stores]
    waiting = in_order(last, known, arguments_of)
    while waiting:
        for one in waiting:
            if text.can(one) and not text.is_of_each(one):
                text.write(one)
        waiting = [one for one in waiting if one not in text.values]
        loop: dict[Matrix, None] = {}
        for one in waiting:
            if text.is_of_each(one) and text.can(one, loop):
                loop[one] = None
        waiting = [one for one in waiting if one not in loop]
        if loop:
            text.write_loop(list(loop), {*last, *(a for one in waiting for a in arguments_of(one))})
    for place, one in stores:
        if known.get(one) != place:
            text.lines += _stored(place, one, text.values[one])
    loops = any(one.member or is_array(*one.shape) for one in text.values if one.shape)
    return written_out("work", ", ".join(arrays), *text.lines, "None", _loops=loops, **text.names)


class _Text:
    """Lines, the functions that they call, and names of what they have worked out."""

    def __init__(self, known: Mapping[Matrix, Place | Callable], functions: Mapping[Operation, Callable]):
        self._known, self._functions = known, functions
        self.lines: list[str] = []
        self.names: dict[str, Any] = {"np": np}
        self.values: dict[Matrix, str] = {}

    def can(self, one: Matrix, others: Collection[Matrix] = ()) -> bool:
        """Whether all is worked out that something is made of, here or among others."""
        return one in self._known or all(a in self.values or a in others for a in arguments_of(one))

    def is_of_each(self, one: Matrix) -> bool:
        """Whether something is worked out for each member by itself."""
        return one.member and one not in self._known and members_called.function_of(one) is None

    def _call(self, name: str, function: Callable, *arguments: str) -> str:
        self.names[name] = function
        return f"{name}({', '.join(arguments)})"

    def _function(self, one: Matrix) -> Callable:
        return self._functions[one.operation] if one.operation in self._functions else function_of(one)

    def write(self, one: Matrix) -> None:
        """A line that works something out, or reads it."""
        value, values = f"v{len(self.values)}", self.values
        if one.operation is operations.present:  # functions look for NaN themselves
            values[one] = values[one.of[0]]
            return
        if one in self._known:
            at = self._known[one]
            text = _read(at, one) if isinstance(at, Place) else self._call(f"read_{value}", at, "numbers")
        elif any(a.member for a in one.of) and (rule := members_called.function_of(one)):
            function, sized = rule
            text = self._call(f"work_{value}", function, *(values[a] for a in one.of), *["size"] * sized)
        else:
            text = self._call(f"work_{value}", self._function(one), *(values[a] for a in arguments_of(one)))
        values[one] = value
        self.lines.append(f"{value} = {text}")

    def write_loop(self, loop: list[Matrix], wanted: Collection[Matrix]) -> None:
        """A loop over the members that works some matrices out; of these, some are wanted after it."""
        inside: dict[Matrix, str] = {}
        lines, columns = [], ""
        for one in loop:
            for a in arguments_of(one):
                if a.member and a not in inside:
                    inside[a] = f"m{len(self.values)}_{len(inside)}"
                    columns = f"{self.values[a]}.shape[1]"
                    read = self._call(f"read_{inside[a]}", members_called.reader(a.shape), self.values[a], "j")
                    lines.append(f"    {inside[a]} = {read}")
            name = f"m{len(self.values)}_{len(inside)}"
            given = (inside.get(a) or self.values[a] for a in arguments_of(one))
            lines.append(f"    {name} = {self._call(f'work_{name}', self._function(one), *given)}")
            inside[one] = name
        kept = [one for one in loop if one in wanted]
        for one in kept:
            value, name = f"v{len(self.values)}", inside[one]
            self.values[one] = value
            self.lines.append(f"{value} = np.empty(({prod(one.shape)}, {columns}))")
            lines.append(f"    {self._call(f'store_{name}', members_called.writer(one.shape), value, 'j', name)}")
        self.lines += [f"for j in range({columns}):", *lines]


def _read(place: Place, one: Matrix) -> str:
    """Source of what lies at a place: tuples of its numbers, or a part of the memory itself."""
    (array, first), shape = place, one.shape
    if one.member:
        if array == "table":
            return f"table[{first}:{first + prod(shape)}]"
        return f"{array}[: {prod(shape)} * table.shape[1]].reshape(({prod(shape)}, table.shape[1]))"
    if not shape:
        return f"{array}[{first}]"
    if _is_array(shape):
        return f"{array}[{first}:{first + prod(shape)}].reshape({shape})"
    *rows, columns = shape
    if not rows:
        return tuple_of(f"{array}[{first + j}]" for j in range(columns))
    return matrix_of(rows[0], columns, lambda i, j: f"{array}[{first + i * columns + j}]")


def _stored(place: Place, one: Matrix, value: str) -> list[str]:
    """Lines that store a value."""
    (array, first), shape = place, one.shape
    if array == "table":
        loops = [f"for i in range({prod(shape)}):", "    for j in range(table.shape[1]):"]
        return [*loops, f"        table[{first} + i, j] = {members_called.entry(value, shape, one.member)}"]
    names, strides = "ijk"[: len(shape)], (prod(shape[k + 1 :]) for k in range(len(shape)))
    at = " + ".join([str(first), *(f"{name} * {stride}" for name, stride in zip(names, strides, strict=True))])
    loops = [f"{'    ' * k}for {name} in range({shape[k]}):" for k, name in enumerate(names)]
    entry = f"[{', '.join(names)}]" if _is_array(shape) else "".join(f"[{name}]" for name in names)
    return [*loops, f"{'    ' * len(shape)}{array}[{at}] = {value}{entry}"]


def _is_array(shape: tuple[int, ...]) -> bool:
    return len(shape) > 2 or bool(shape) and is_array(*shape)
