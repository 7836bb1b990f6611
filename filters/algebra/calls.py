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
from functools import cache
from math import prod
from typing import Any

import numpy as np

from filters.algebra import blocks as blocks_called
from filters.algebra import geometric, matrices, operations
from filters.algebra import members as members_called
from filters.algebra import points as points_called
from filters.algebra import samples as densities
from filters.algebra import upper as upper_called
from filters.algebra.blocks import by_entries
from filters.algebra.matrices import Matrix, Operation, in_order
from thruster_env.core import matrices as made
from thruster_env.core.angles import NAMES, short_way
from thruster_env.core.sources import Source, entrywise, is_array, matrix_of, tuple_of, written_out
from thruster_env.graphs.programs import ARRAYS, Place

# Operations on matrices as functions made for their sizes, for `calls`: of tuples, or in loops over arrays.


def arguments_of(one: Matrix) -> tuple[Matrix, ...]:
    """What the function of an operation takes."""
    if _by_transpose(one):
        return one.arguments[0], one.arguments[1].arguments[0]
    if one.operation is operations.congruence:
        return one.arguments[0], one.arguments[2]
    if one.operation is operations.of_best_gain:  # of P, C = P H' and K it is P - C K'
        return one.arguments[1], one.arguments[2], one.arguments[4]
    return () if one.operation is operations.eye else one.of


def _by_transpose(one: Matrix) -> bool:
    """Whether a product is by a transposed matrix, which functions do not form."""
    return one.operation is matrices.multiply and one.arguments[1].operation is matrices.transposed


def function_of(one: Matrix) -> Callable:
    """The function that works out an operation of ours, of what `arguments_of` says."""
    others = tuple(a for a in one.arguments if not isinstance(a, Matrix))
    return _function(one.operation, one.shape, _by_transpose(one), others, *(a.shape for a in one.of))


@cache
def _function(operation: Operation, result: tuple, by_transpose: bool, others: tuple, *shapes: tuple) -> Callable:
    """The same for all operations alike: compiled code then has it once."""
    if operation is matrices.multiply:
        return _product(by_transpose, *shapes)
    if operation not in _FUNCTIONS:
        raise ValueError(f"{operation.name} is for models that are small and can be traced, but this one is not")
    return _FUNCTIONS[operation](result, *others, *shapes)


def _multiple(result: tuple, *others) -> Callable:
    return by_entries("{a} * {0!r}" if isinstance(others[0], float) else "{a} * {b}")(result, *others)


def _product(by_transpose: bool, a: tuple, b: tuple) -> Callable:
    if len(b) == 1:
        return made.vector_multiplier(*a)
    return made.transposed_multiplier(*a, b[1]) if by_transpose else made.multiplier(*a, b[1])


def _mirrored(shape: tuple, *of: tuple) -> Callable:
    source = Source("mirrored", "a", result=shape, a=shape)
    return source.function(source.symmetric("s", shape[0], lambda i, j: f"a[{i}][{j}]"))


def _congruence(shape: tuple, a: tuple, p: tuple, pa: tuple) -> Callable:
    names: dict[str, Any] = {"times": made.multiplier(*a, a[0]), "mirror": _mirrored(shape, shape)}
    return written_out("congruence", "a, pa", "mirror(times(a, pa))", **names)


def _of_best_gain(shape: tuple, value: tuple, p: tuple, c: tuple, s: tuple, k: tuple) -> Callable:
    names: dict[str, Any] = {"times": made.transposed_multiplier(*c, shape[0]), "mirror": _mirrored(shape, shape)}
    names["less"] = by_entries("{a} - {b}")(p, p, p)
    return written_out("of_best_gain", "p, c, k", "less(p, mirror(times(c, k)))", **names)


def _with_transposed(shape: tuple, *of: tuple) -> Callable:
    return entrywise("total", "a", shape, lambda i, j: f"a[{i}][{j}] + a[{j}][{i}]", a=shape)


def _identity(shape: tuple, *of: tuple) -> Callable:
    source = Source("identity", "", result=shape)
    return source.function(source.entries(shape, lambda i, j: source.if_same(i, j, "1.0", "0.0")))


def _on_one_branch(shape: tuple, angles: tuple[bool, ...], *of: tuple) -> Callable:
    source = Source("wrapped_angles", "a", result=shape, a=shape)

    def entry(i, *others) -> str:
        return short_way(f"a[{i}]" + "".join(f"[{j}]" for j in others), i, angles)

    return source.function(source.entries(shape, entry), **NAMES)


def _only(result: tuple, z: tuple, shape: tuple) -> Callable:
    def entry(i, *others) -> str:
        return f"(a[{i}]" + "".join(f"[{j}]" for j in others) + f" if z[{i}] == z[{i}] else 0.0)"

    return entrywise("only", "z, a", shape, entry, z=z, a=shape)


def _uncorrelated(result: tuple, z: tuple, shape: tuple) -> Callable:
    return written_out("uncorrelated", "z, r", "mask(r, z)", mask=made.masked(*z))


def _quotient(result: tuple, c: tuple, of: tuple) -> Callable:
    return made.vector_solver(*c) if len(c) == 1 else made.row_solver(*c)


def _inverse(result: tuple, of: tuple, z: tuple) -> Callable:
    source = Source("known", "s, z", result=of, s=of, z=z)
    missing = "(s[{0}][{0}] if z[{0}] == z[{0}] else 0.0)"
    entries = source.entries(of, lambda i, j: source.if_same(i, j, missing.format(i), f"s[{i}][{j}]"))
    names: dict[str, Any] = {"known": source.function(entries), "invert": made.factored_inverse(of[0])}
    return written_out("inverse", "l, z", "known(invert(l), z)", **names)


def _dot(result: tuple, a: tuple, b: tuple) -> Callable:
    source = Source("dot", "a, b", a=a, b=b)
    return source.function(source.sum(f"a[{i}] * b[{i}]" for i in source.range(*a)))


def _stretch(result: tuple, w: tuple, other: tuple, e: tuple, ds: tuple) -> Callable:
    source = Source("stretch", "w, o, e, ds", work=prod(e), w=w, o=other, e=e, ds=ds)
    rows = source.range(*w)
    terms = (f"(w[{i}] * o[{j}] - e[{i}][{j}]) * ds[{i}][{j}]" for i in rows for j in source.range(*w))
    return source.function(f"0.5 * ({source.sum(terms)})")


def _of_tail(text: str) -> Callable:
    def make(result: tuple, q: tuple, z: tuple, tail: tuple) -> Callable:
        source = Source("of_tail", "q, z, tail", z=z, tail=tail)
        source.line("d = " + source.sum(f"(1 if z[{i}] == z[{i}] else 0)" for i in source.range(*z)))
        return source.function(text, log=np.log)

    return make


HEAVIER = "tail[1 + int(d)] + 0.5 * q - 0.5 * (1.0 / tail[0] + d) * log(1.0 + tail[0] * q / (1.0 - 2.0 * tail[0]))"
WEIGHT = "(1.0 + tail[0] * d) / (1.0 - 2.0 * tail[0] + tail[0] * q)"

_FUNCTIONS: dict[Operation, Callable] = {
    matrices.scale: _multiple,
    matrices.transposed: lambda result, shape: made.transposer(*shape),
    operations.mirrored: _mirrored,
    operations.with_transposed: _with_transposed,
    operations.congruence: _congruence,
    operations.of_best_gain: _of_best_gain,
    operations.eye: _identity,
    operations.on_one_branch: _on_one_branch,
    operations.only: _only,
    operations.uncorrelated: _uncorrelated,
    operations.factor: lambda result, shape: made.cholesky_factor(shape[0]),
    operations.quotient: _quotient,
    operations.inverse: _inverse,
    densities.density: lambda result, v, of, z: made.innovation_likelihood(*v),
    densities.dot: _dot,
    densities.stretch: _stretch,
    densities.heavier: _of_tail(f"({HEAVIER} if tail[0] > 0.0 else 0.0)"),
    densities.outlier_weight: _of_tail(WEIGHT),
    **points_called.FUNCTIONS,
    **blocks_called.FUNCTIONS,
    **members_called.FUNCTIONS,
    **geometric.FUNCTIONS,
    **upper_called.FUNCTIONS,
}


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
