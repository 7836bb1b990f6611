"""Vectors and matrices as tuples: one form that floats, arrays, tensors and numba all run fast.

A vector is a tuple of components, a matrix a tuple of rows. The makers here write a function out for a fixed
size, as `collections.namedtuple` does for its classes: numba then sees tuples of known length, keeps them in
registers and vectorises the loop around. Vectors and matrices that are large are arrays instead, which the same
makers read and write in loops (`numerics.sources`).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

from numerics.sources import Source, is_array, matrix_of, tuple_of, written_out

__all__ = [
    "column_reader",
    "column_writer",
    "matrix_of",
    "matrix_reader",
    "matrix_writer",
    "part_of",
    "scaled_sum",
    "tuple_of",
    "vector_reader",
    "vector_writer",
    "written_out",
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
def part_of(rows: int, columns: int, whole: tuple[int, int], top: int = 0, left: int = 0) -> Callable:
    """Return `part(a)`: the `rows` and `columns` of a matrix of the shape `whole` that begin at (top, left)."""
    source = Source("part", "a", result=(rows, columns), a=whole)
    return source.function(source.matrix(rows, columns, lambda i, j: f"a[{i + top}][{j + left}]"))
