"""Graphs of matrices as calls of functions for their sizes: for models of any size, and of any kind.

If a model's functions cannot be traced, or the graph of all numbers would be too large, each operation on matrices
is a line that calls the function for these sizes (`thruster_env.core.matrices`): on tuples in registers, or in
loops over arrays.

    v2 = work2(v0, v1)
    store(rows, v2)

Operations on single members of an ensemble stand in a loop over the members, as many in one loop as their order
allows.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from functools import cache
from math import prod
from typing import Any

import numpy as np

from filters.algebra import matrices, members, operations, points, roots, tangents
from filters.algebra import operations as geometric
from filters.algebra.matrices import Matrix, Operation, in_order
from filters.algebra.roots import by_entries
from thruster_env.core import matrices as matrix_functions
from thruster_env.core.angles import NAMES, short_way
from thruster_env.core.sources import Source, entrywise, is_array, matrix_of, tuple_of, written_out
from thruster_env.graphs.programs import ARRAYS, Place
from thruster_env.model.traced import MOST_TURNING


def arguments_of(matrix: Matrix) -> tuple[Matrix, ...]:
    """The arguments of the function that evaluates a matrix, see `function_of`."""
    if _by_transpose(matrix):
        return matrix.arguments[0], matrix.arguments[1].arguments[0]
    if matrix.operation is operations.congruence:
        return matrix.arguments[0], matrix.arguments[2]
    if matrix.operation is operations.of_best_gain:  # P - C K', a function of P, C = P H' and K
        return matrix.arguments[1], matrix.arguments[2], matrix.arguments[4]
    return () if matrix.operation is operations.eye else matrix.of


def _by_transpose(matrix: Matrix) -> bool:
    return matrix.operation is matrices.multiply and matrix.arguments[1].operation is matrices.transposed


def function_of(matrix: Matrix) -> Callable:
    """The function that evaluates a matrix from `arguments_of` it, if its operation is not a model's."""
    parameters = tuple(a for a in matrix.arguments if not isinstance(a, Matrix))
    return _function(
        matrix.operation, matrix.shape, _by_transpose(matrix), parameters, *(a.shape for a in matrix.of)
    )


@cache
def _function(
    operation: Operation, result: tuple, by_transpose: bool, parameters: tuple, *shapes: tuple
) -> Callable:
    """One function for all equal operations, so that it is compiled once."""
    if operation is matrices.multiply:
        return _product(by_transpose, *shapes)
    if operation not in _FUNCTIONS and operation.compute.__module__ == tangents.__name__:
        raise ValueError(
            "a filter of rotations must have functions that can be traced, and a prediction and an update of at "
            f"most {MOST_TURNING} operations each, but this one has not: use 'ekf', fewer states, measurements or "
            "iterations, and loops of known lengths"
        )
    if operation not in _FUNCTIONS:
        raise ValueError(f"{operation.name} is for models that are small and can be traced, but this one is not")
    return _FUNCTIONS[operation](result, *parameters, *shapes)


def _multiple(result: tuple, *arguments) -> Callable:
    return by_entries("{a} * {0!r}" if isinstance(arguments[0], float) else "{a} * {b}")(result, *arguments)


def _product(by_transpose: bool, a: tuple, b: tuple) -> Callable:
    if len(b) == 1:
        return matrix_functions.vector_multiplier(*a)
    return (
        matrix_functions.transposed_multiplier(*a, b[1]) if by_transpose else matrix_functions.multiplier(*a, b[1])
    )


def _mirrored(shape: tuple, *of: tuple) -> Callable:
    source = Source("mirrored", "a", result=shape, a=shape)
    return source.function(source.symmetric("s", shape[0], lambda i, j: f"a[{i}][{j}]"))


def _congruence(shape: tuple, a: tuple, p: tuple, pa: tuple) -> Callable:
    names: dict[str, Any] = {"times": matrix_functions.multiplier(*a, a[0]), "mirror": _mirrored(shape, shape)}
    return written_out("congruence", "a, pa", "mirror(times(a, pa))", **names)


def _of_best_gain(shape: tuple, value: tuple, p: tuple, c: tuple, s: tuple, k: tuple) -> Callable:
    names: dict[str, Any] = {
        "times": matrix_functions.transposed_multiplier(*c, shape[0]),
        "mirror": _mirrored(shape, shape),
    }
    names["less"] = by_entries("{a} - {b}")(p, p, p)
    return written_out("of_best_gain", "p, c, k", "less(p, mirror(times(c, k)))", **names)


def _with_transposed(shape: tuple, *of: tuple) -> Callable:
    return entrywise("total", "a", shape, lambda i, j: f"a[{i}][{j}] + a[{j}][{i}]", a=shape)


def _identity(shape: tuple, *of: tuple) -> Callable:
    source = Source("identity", "", result=shape)
    return source.function(source.entries(shape, lambda i, j: source.if_same(i, j, "1.0", "0.0")))


def _on_one_branch(shape: tuple, angles: tuple[bool, ...], *of: tuple) -> Callable:
    source = Source("wrapped_angles", "a", result=shape, a=shape)

    def entry(i, *rest) -> str:
        return short_way(f"a[{i}]" + "".join(f"[{j}]" for j in rest), i, angles)

    return source.function(source.entries(shape, entry), **NAMES)


def _only(result: tuple, z: tuple, shape: tuple) -> Callable:
    def entry(i, *rest) -> str:
        return f"(a[{i}]" + "".join(f"[{j}]" for j in rest) + f" if z[{i}] == z[{i}] else 0.0)"

    return entrywise("mask_missing", "z, a", shape, entry, z=z, a=shape)


def _uncorrelated(result: tuple, z: tuple, shape: tuple) -> Callable:
    return written_out("uncorrelated", "z, r", "mask(r, z)", mask=matrix_functions.masked(*z))


def _quotient(result: tuple, c: tuple, of: tuple) -> Callable:
    return matrix_functions.vector_solver(*c) if len(c) == 1 else matrix_functions.row_solver(*c)


def _inverse(result: tuple, of: tuple, z: tuple) -> Callable:
    source = Source("known", "s, z", result=of, s=of, z=z)
    missing = "(s[{0}][{0}] if z[{0}] == z[{0}] else 0.0)"
    entries = source.entries(of, lambda i, j: source.if_same(i, j, missing.format(i), f"s[{i}][{j}]"))
    names: dict[str, Any] = {"known": source.function(entries), "invert": matrix_functions.factored_inverse(of[0])}
    return written_out("inverse", "l, z", "known(invert(l), z)", **names)


def _dot(result: tuple, a: tuple, b: tuple) -> Callable:
    source = Source("dot", "a, b", a=a, b=b)
    return source.function(source.sum(f"a[{i}] * b[{i}]" for i in source.range(*a)))


def _half_trace(result: tuple, w: tuple, other: tuple, e: tuple, ds: tuple) -> Callable:
    source = Source("half_trace", "w, o, e, ds", work=prod(e), w=w, o=other, e=e, ds=ds)
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
    matrices.transposed: lambda result, shape: matrix_functions.transposer(*shape),
    operations.mirrored: _mirrored,
    operations.with_transposed: _with_transposed,
    operations.congruence: _congruence,
    operations.of_best_gain: _of_best_gain,
    operations.eye: _identity,
    operations.on_one_branch: _on_one_branch,
    operations.mask_missing: _only,
    operations.uncorrelated: _uncorrelated,
    operations.factor: lambda result, shape: matrix_functions.cholesky_factor(shape[0]),
    operations.quotient: _quotient,
    operations.inverse: _inverse,
    points.density: lambda result, v, of, z: matrix_functions.innovation_likelihood(*v),
    points.dot: _dot,
    points.half_trace: _half_trace,
    points.heavier: _of_tail(f"({HEAVIER} if tail[0] > 0.0 else 0.0)"),
    points.outlier_weight: _of_tail(WEIGHT),
    **points.FUNCTIONS,
    **roots.FUNCTIONS,
    **members.FUNCTIONS,
    **geometric.FUNCTIONS,
    **roots.UD_FUNCTIONS,
}


def calls_of(
    stores: Sequence[tuple[Place, Matrix]],
    known: Mapping[Matrix, Place | Callable],
    functions: Mapping[Operation, Callable],
    arrays: Sequence[str] = ARRAYS,
) -> Callable:
    """`work(*arrays)`, which evaluates matrices and stores them; compiled functions may call it.

    Args:
        stores: pairs of a place and the matrix to store there.
        known: for each given matrix its place, or a function of `numbers` that reads it.
        functions: for each operation of a model the function that evaluates it.
        arrays: names of the arguments.
    """
    text, last = _Text(known, functions), [matrix for _, matrix in stores]
    waiting = in_order(last, known, arguments_of)
    while waiting:
        for matrix in waiting:
            if text.can(matrix) and not text.is_of_each(matrix):
                text.write(matrix)
        waiting = [matrix for matrix in waiting if matrix not in text.values]
        loop: dict[Matrix, None] = {}
        for matrix in waiting:
            if text.is_of_each(matrix) and text.can(matrix, loop):
                loop[matrix] = None
        waiting = [matrix for matrix in waiting if matrix not in loop]
        if loop:
            text.write_loop(list(loop), {*last, *(a for matrix in waiting for a in arguments_of(matrix))})
    for position, matrix in stores:
        if known.get(matrix) != position:
            text.lines += _stored(position, matrix, text.values[matrix])
    return written_out("work", ", ".join(arrays), *text.lines, "None", **text.names)


class _Text:
    """Lines, the functions that they call, and the names of the matrices that they have evaluated."""

    def __init__(self, known: Mapping[Matrix, Place | Callable], functions: Mapping[Operation, Callable]):
        self._known, self._functions = known, functions
        self.lines: list[str] = []
        self.names: dict[str, Any] = {"np": np}
        self.values: dict[Matrix, str] = {}

    def can(self, matrix: Matrix, loop: Collection[Matrix] = ()) -> bool:
        return matrix in self._known or all(a in self.values or a in loop for a in arguments_of(matrix))

    def is_of_each(self, matrix: Matrix) -> bool:
        """Whether a matrix is evaluated in a loop over the members."""
        return matrix.member and matrix not in self._known and members.function_of(matrix) is None

    def _call(self, name: str, function: Callable, *arguments: str) -> str:
        self.names[name] = function
        return f"{name}({', '.join(arguments)})"

    def _function(self, matrix: Matrix) -> Callable:
        return self._functions[matrix.operation] if matrix.operation in self._functions else function_of(matrix)

    def write(self, matrix: Matrix) -> None:
        value, values = f"v{len(self.values)}", self.values
        if matrix.operation is operations.present:  # functions look for NaN themselves
            values[matrix] = values[matrix.of[0]]
            return
        if matrix in self._known:
            at = self._known[matrix]
            text = _read(at, matrix) if isinstance(at, Place) else self._call(f"read_{value}", at, "numbers")
        elif any(a.member for a in matrix.of) and (rule := members.function_of(matrix)):
            function, sized = rule
            text = self._call(f"work_{value}", function, *(values[a] for a in matrix.of), *["size"] * sized)
        else:
            text = self._call(f"work_{value}", self._function(matrix), *(values[a] for a in arguments_of(matrix)))
        values[matrix] = value
        self.lines.append(f"{value} = {text}")

    def write_loop(self, loop: list[Matrix], wanted: Collection[Matrix]) -> None:
        """Add a loop over the members that evaluates matrices, and stores those that are wanted after it."""
        inside: dict[Matrix, str] = {}
        lines, columns = [], ""
        for matrix in loop:
            for a in arguments_of(matrix):
                if a.member and a not in inside:
                    inside[a] = f"m{len(self.values)}_{len(inside)}"
                    columns = f"{self.values[a]}.shape[1]"
                    read = self._call(f"read_{inside[a]}", members.reader(a.shape), self.values[a], "j")
                    lines.append(f"    {inside[a]} = {read}")
            name = f"m{len(self.values)}_{len(inside)}"
            operands = (inside.get(a) or self.values[a] for a in arguments_of(matrix))
            lines.append(f"    {name} = {self._call(f'work_{name}', self._function(matrix), *operands)}")
            inside[matrix] = name
        results = [matrix for matrix in loop if matrix in wanted]
        for matrix in results:
            value, name = f"v{len(self.values)}", inside[matrix]
            self.values[matrix] = value
            self.lines.append(f"{value} = np.empty(({prod(matrix.shape)}, {columns}))")
            lines.append(f"    {self._call(f'store_{name}', members.writer(matrix.shape), value, 'j', name)}")
        self.lines += [f"for j in range({columns}):", *lines]


def _read(position: Place, matrix: Matrix) -> str:
    (array, first), shape = position, matrix.shape
    if matrix.member:
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


def _stored(position: Place, matrix: Matrix, value: str) -> list[str]:
    (array, first), shape = position, matrix.shape
    if array == "table":
        loops = [f"for i in range({prod(shape)}):", "    for j in range(table.shape[1]):"]
        return [*loops, f"        table[{first} + i, j] = {members.entry(value, shape, matrix.member)}"]
    names, strides = "ijk"[: len(shape)], (prod(shape[k + 1 :]) for k in range(len(shape)))
    at = " + ".join([str(first), *(f"{name} * {stride}" for name, stride in zip(names, strides, strict=True))])
    loops = [f"{'    ' * k}for {name} in range({shape[k]}):" for k, name in enumerate(names)]
    entry = f"[{', '.join(names)}]" if _is_array(shape) else "".join(f"[{name}]" for name in names)
    return [*loops, f"{'    ' * len(shape)}{array}[{at}] = {value}{entry}"]


def _is_array(shape: tuple[int, ...]) -> bool:
    return len(shape) > 2 or bool(shape) and is_array(*shape)
