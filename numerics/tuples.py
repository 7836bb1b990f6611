"""Vectors and matrices as tuples: one form that floats, arrays, tensors and numba all run fast.

A vector is a tuple of components, a matrix a tuple of rows. The makers here write a function out for a fixed
size, as `collections.namedtuple` does for its classes: numba then sees tuples of known length, keeps them in
registers and vectorises the loop around.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import cache

from numerics.compiled import inlined


def tuple_of(expressions: Iterable[str]) -> str:
    """Source of a tuple with the given expressions."""
    return "(" + "".join(f"{expression}, " for expression in expressions) + ")"


def matrix_of(rows: int, columns: int, entry: Callable[[int, int], str]) -> str:
    """Source of a matrix whose entries have the sources entry(i, j)."""
    return tuple_of(tuple_of(entry(i, j) for j in range(columns)) for i in range(rows))


def written_out(name: str, arguments: str, *lines: str, **names) -> Callable:
    """Make a function from source lines, whose last is the expression it returns; `names` are its globals."""
    names["__name__"] = __name__  # without a module, pickling for numba's cache searches all of them
    body = "".join(f"    {line}\n" for line in (*lines[:-1], f"return {lines[-1]}"))
    exec(f"def {name}({arguments}):\n{body}", names)
    return inlined(names[name])


@cache
def column_reader(count: int, first: int = 0) -> Callable:
    """Return `column(array, j)`: `count` entries of column j, from row first on, as a tuple."""
    return written_out("column", "array, j", tuple_of(f"array[{first + i}, j]" for i in range(count)))


@cache
def column_writer(count: int, first: int = 0) -> Callable:
    """Return `store(array, j, x)`: write the tuple x into rows first, first + 1, ... of column j."""
    lines = (f"array[{first + i}, j] = x[{i}]" for i in range(count))
    return written_out("store", "array, j, x", *lines, "None")


@cache
def vector_reader(count: int, start: int = 0) -> Callable:
    """Return `read(row)`: entries start ... start + count - 1 of a one-dimensional array as a tuple."""
    return written_out("read", "row", tuple_of(f"row[{start + i}]" for i in range(count)))


@cache
def vector_writer(count: int, start: int = 0) -> Callable:
    """Return `store(row, x)`: write the tuple x of `count` components into row[start], row[start + 1], ..."""
    return written_out("store", "row, x", *(f"row[{start + i}] = x[{i}]" for i in range(count)), "None")


@cache
def matrix_reader(rows: int, columns: int, start: int = 0) -> Callable:
    """Return `read(row)`: a matrix that lies by rows in row[start], row[start + 1], ..., as a tuple of rows."""
    source = matrix_of(rows, columns, lambda i, j: f"row[{start + i * columns + j}]")
    return written_out("read", "row", source)


@cache
def matrix_writer(rows: int, columns: int, start: int = 0) -> Callable:
    """Return `store(row, a)`: write a matrix by rows into row[start], row[start + 1], ..."""
    places = ((i, j) for i in range(rows) for j in range(columns))
    lines = (f"row[{start + i * columns + j}] = a[{i}][{j}]" for i, j in places)
    return written_out("store", "row, a", *lines, "None")


@cache
def scaled_sum(count: int) -> Callable:
    """Return `add(x, a, y)`: the tuple x + a y for tuples of `count` components and a scalar a."""
    return written_out("add", "x, a, y", tuple_of(f"x[{i}] + a * y[{i}]" for i in range(count)))
