"""Dense matrices as tuples of rows, with every operation written out for its size, and large ones as arrays.

Compiled, small ones stay in registers and cost nanoseconds where a library call costs hundreds. The source of
large ones, which would grow with the cube of the size, has loops instead (`thruster_env.core.sources`).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

from thruster_env.core import arrays
from thruster_env.core.sources import Source, is_array
from thruster_env.core.triangles import (
    careful_factor,
    cholesky_factor,
    column_solver,
    factored_inverse,
    forward_solver,
    innovation_likelihood,
    pivoted_factor,
    row_solver,
    semidefinite_factor,
    square,
    triangle_divider,
    triangular_root,
    vector_solver,
)

__all__ = [
    "careful_factor",
    "cholesky_factor",
    "column_solver",
    "factored_inverse",
    "forward_solver",
    "innovation",
    "innovation_likelihood",
    "masked",
    "multiplier",
    "pivoted_factor",
    "quadratic_form",
    "row_solver",
    "semidefinite_factor",
    "square",
    "symmetric_sum",
    "transposed_multiplier",
    "transposer",
    "triangle_divider",
    "triangular_root",
    "vector_multiplier",
    "vector_solver",
]


@cache
def multiplier(rows: int, inner: int, columns: int) -> Callable:
    """Return `multiply(a, b)`: a b for shapes (rows, inner) and (inner, columns)."""
    shapes = {"result": (rows, columns), "a": (rows, inner), "b": (inner, columns)}
    if all(is_array(*shape) for shape in shapes.values()):
        return arrays.product
    source = Source("multiply", "a, b", **shapes, work=rows * inner * columns)

    def entry(i, j):
        return source.sum(f"a[{i}][{k}] * b[{k}][{j}]" for k in source.range(inner))

    return source.function(source.matrix(rows, columns, entry))


@cache
def transposed_multiplier(rows: int, inner: int, columns: int) -> Callable:
    """Return `multiply(a, b)`: a b' for shapes (rows, inner) and (columns, inner)."""
    shapes = {"result": (rows, columns), "a": (rows, inner), "b": (columns, inner)}
    if all(is_array(*shape) for shape in shapes.values()):
        return arrays.product_of_rows
    source = Source("multiply", "a, b", **shapes, work=rows * inner * columns)

    def entry(i, j):
        return source.sum(f"a[{i}][{k}] * b[{j}][{k}]" for k in source.range(inner))

    return source.function(source.matrix(rows, columns, entry))


@cache
def transposer(rows: int, columns: int) -> Callable:
    """Return `transpose(a)`: a' for a of shape (rows, columns)."""
    source = Source("transpose", "a", result=(columns, rows), a=(rows, columns))
    return source.function(source.matrix(columns, rows, lambda i, j: f"a[{j}][{i}]"))


@cache
def vector_multiplier(rows: int, inner: int) -> Callable:
    """Return `multiply(a, x)`: the tuple a x for shapes (rows, inner) and (inner,)."""
    source = Source("multiply", "a, x", result=(rows,), a=(rows, inner), x=(inner,), work=rows * inner)
    return source.function(
        source.vector(rows, lambda i: source.sum(f"a[{i}][{k}] * x[{k}]" for k in source.range(inner)))
    )


@cache
def quadratic_form(rows: int, columns: int) -> Callable:
    """Return `form(a, w)`: a' w a for a of shape (rows, columns) and w of shape (rows, rows)."""
    shapes = {"result": (columns, columns), "a": (rows, columns), "w": (rows, rows)}
    source = Source("form", "a, w", **shapes, work=rows * rows * columns)
    if source.loops:
        half = source.local("half", rows, columns)  # w a
        for p in source.range(rows):
            for j in source.range(columns):
                source.line(
                    f"{half[p, j]} = {source.sum(f'w[{p}][{q}] * a[{q}][{j}]' for q in source.range(rows))}"
                )

        def entry(i, j):
            return source.sum(f"a[{p}][{i}] * {half[p, j]}" for p in source.range(rows))

        return source.function(source.matrix(columns, columns, entry))

    def sum_of_products(i, j):
        return " + ".join(f"a[{p}][{i}] * w[{p}][{q}] * a[{q}][{j}]" for p in range(rows) for q in range(rows))

    return source.function(source.matrix(columns, columns, sum_of_products))


@cache
def symmetric_sum(size: int) -> Callable:
    """Return `add(a, b)`: the symmetric part of a + b, exactly symmetric."""
    shape = size, size
    source = Source("add", "a, b", result=shape, a=shape, b=shape)

    def entry(i, j):
        return f"0.5 * (a[{i}][{j}] + a[{j}][{i}] + b[{i}][{j}] + b[{j}][{i}])"

    return source.function(source.symmetric("s", size, entry))


@cache
def innovation(size: int, first: int = 0) -> Callable:
    """Return `subtract(z, y)`: z - y[first:], zero in channels that are NaN in z."""
    source = Source("subtract", "z, y", result=(size,), z=(size,), y=(first + size,))

    def entry(i):
        return f"z[{i}] - y[{first + i}] if z[{i}] == z[{i}] else 0.0"

    return source.function(source.vector(size, entry))


@cache
def masked(size: int) -> Callable:
    """Return `mask(r, z)`: the covariance r without its correlations to channels that are NaN in z."""
    source = Source("mask", "r, z", result=(size, size), r=(size, size), z=(size,))

    def entry(i, j):
        here = f"r[{i}][{j}]"
        return source.if_same(i, j, here, f"({here} if z[{i}] == z[{i}] and z[{j}] == z[{j}] else 0.0)")

    return source.function(source.matrix(size, size, entry))
