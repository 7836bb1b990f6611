"""Vectors and matrices as tuples: one form that floats, arrays, tensors and numba all run fast.

A vector is a tuple of components, a matrix a tuple of rows. The makers here write a function out for a fixed
size, as `collections.namedtuple` does for its classes: numba then sees tuples of known length, keeps them in
registers and vectorises the loop around. Vectors and matrices that are large are arrays instead, which the same
makers read and write in loops (`thruster_env.core.sources`).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np

from thruster_env.core.sources import Source, entrywise, is_array, matrix_of, tuple_of, written_out

__all__ = [
    "assembled",
    "column_reader",
    "column_writer",
    "joiner",
    "matrix_of",
    "matrix_reader",
    "matrix_writer",
    "part_of",
    "scaled_sum",
    "tuple_of",
    "vector_part",
    "vector_reader",
    "vector_writer",
    "written_out",
    "zeros_of",
]


@cache
def column_reader(count: int, first: int = 0) -> Callable:
    """Return `column(array, j)`: `count` entries of column j, from row first on, as a tuple."""
    source = Source("column", "array, j", result=(count,))
    return source.function(source.vector(count, lambda i: f"array[{first + i}, j]"))


@cache
def column_writer(count: int, first: int = 0) -> Callable:
    """Return `store(array, j, x)`: write the tuple x into rows first, first + 1, ... of column j."""
    source = Source("store", "array, j, x", x=(count,))
    for i in source.range(count):
        source.line(f"array[{first + i}, j] = x[{i}]")
    return source.function()


@cache
def vector_reader(count: int, start: int = 0) -> Callable:
    """Return `read(row)`: entries start ... start + count - 1 of a one-dimensional array as a tuple."""
    source = Source("read", "row", result=(count,))
    return source.function(source.vector(count, lambda i: f"row[{start + i}]"))


@cache
def vector_writer(count: int, start: int = 0) -> Callable:
    """Return `store(row, x)`: write the tuple x of `count` components into row[start], row[start + 1], ..."""
    source = Source("store", "row, x", x=(count,))
    for i in source.range(count):
        source.line(f"row[{start + i}] = x[{i}]")
    return source.function()


@cache
def matrix_reader(rows: int, columns: int, start: int = 0) -> Callable:
    """Return `read(row)`: a matrix that lies by rows in row[start], row[start + 1], ..., as a tuple of rows."""
    source = Source("read", "row", result=(rows, columns))
    return source.function(source.matrix(rows, columns, lambda i, j: f"row[{i * columns + j + start}]"))


@cache
def matrix_writer(rows: int, columns: int, start: int = 0) -> Callable:
    """Return `store(row, a)`: write a matrix by rows into row[start], row[start + 1], ..."""
    source = Source("store", "row, a", a=(rows, columns))
    for i in source.range(rows):
        for j in source.range(columns):
            source.line(f"row[{i * columns + j + start}] = a[{i}][{j}]")
    return source.function()


@cache
def scaled_sum(count: int) -> Callable:
    """Return `add(x, a, y)`: the tuple x + a y for tuples of `count` components and a scalar a."""
    if is_array(count):
        return written_out("add", "x, a, y", "x + a * y", _loops=True)  # of any type: also of complex numbers
    return written_out("add", "x, a, y", tuple_of(f"x[{i}] + a * y[{i}]" for i in range(count)))


@cache
def vector_part(count: int, whole: int, first: int = 0) -> Callable:
    """Return `part(x)`: the `count` components from the first on, of a vector of `whole`."""
    source = Source("part", "x", result=(count,), x=(whole,))
    return source.function(source.vector(count, lambda i: f"x[{i + first}]"))


@cache
def joiner(first: int, second: int) -> Callable:
    """Return `join(x, y)`: one vector of the components of two."""
    source = Source("join", "x, y", result=(first + second,), x=(first,), y=(second,))
    both = source.local("z", first + second)
    for i in source.range(first):
        source.line(f"{both[i]} = x[{i}]")
    for i in source.range(second):
        source.line(f"{both[i + first]} = y[{i}]")
    return source.function(source.whole(both))


def assembled(name: str, arguments: str, shape: tuple[int, int], parts: dict) -> Callable:
    """Return the function of a matrix of a shape that is made of parts, zero elsewhere.

    Args:
        name: of the function.
        arguments: names of the parts, comma separated.
        shape: rows and columns of the result.
        parts: of each part its shape, and the row and column at which it begins.
    """
    source = Source(name, arguments, result=shape, **{part: size for part, (size, _, _) in parts.items()})
    if not source.loops:
        entries = {
            (top + i, left + j): f"{part}[{i}][{j}]"
            for part, (size, top, left) in parts.items()
            for i, j in np.ndindex(*size)
        }
        return source.function(matrix_of(*shape, lambda i, j: entries.get((i, j), "0.0")))
    whole = source.local("whole", *shape)
    for part, (size, top, left) in parts.items():
        for i in source.range(size[0]):
            for j in source.range(size[1]):
                source.line(f"{whole[i + top, j + left]} = {part}[{i}][{j}]")
    return source.function(source.whole(whole))


@cache
def zeros_of(*shape: int) -> Callable:
    """Return `zeros()`: a vector (count,) or matrix (rows, columns) of zeros."""
    return entrywise("zeros", "", shape, lambda *place: "0.0")


@cache
def part_of(rows: int, columns: int, whole: tuple[int, int], top: int = 0, left: int = 0) -> Callable:
    """Return `part(a)`: the `rows` and `columns` of a matrix of the shape `whole` that begin at (top, left)."""
    source = Source("part", "a", result=(rows, columns), a=whole)
    return source.function(source.matrix(rows, columns, lambda i, j: f"a[{i + top}][{j + left}]"))
