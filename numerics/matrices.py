"""Small dense matrices as tuples of rows, with every operation written out for its size.

Compiled, they stay in registers and cost nanoseconds where a library call costs hundreds. Meant for models of
up to about ten states: the written-out source grows with the cube of the size.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache

from numerics.tuples import matrix_of, tuple_of, written_out

RESOLUTION = 1e-15  # of the difference of two float64, relative to them


@cache
def multiplier(rows: int, inner: int, columns: int) -> Callable:
    """Return `multiply(a, b)`: a b for shapes (rows, inner) and (inner, columns)."""
    return written_out(
        "multiply",
        "a, b",
        matrix_of(rows, columns, lambda i, j: " + ".join(f"a[{i}][{k}] * b[{k}][{j}]" for k in range(inner))),
    )


@cache
def transposed_multiplier(rows: int, inner: int, columns: int) -> Callable:
    """Return `multiply(a, b)`: a b' for shapes (rows, inner) and (columns, inner)."""
    return written_out(
        "multiply",
        "a, b",
        matrix_of(rows, columns, lambda i, j: " + ".join(f"a[{i}][{k}] * b[{j}][{k}]" for k in range(inner))),
    )


@cache
def vector_multiplier(rows: int, inner: int) -> Callable:
    """Return `multiply(a, x)`: the tuple a x for shapes (rows, inner) and (inner,)."""
    return written_out(
        "multiply",
        "a, x",
        tuple_of(" + ".join(f"a[{i}][{k}] * x[{k}]" for k in range(inner)) for i in range(rows)),
    )


@cache
def quadratic_form(rows: int, columns: int) -> Callable:
    """Return `form(a, w)`: a' w a for a of shape (rows, columns) and w of shape (rows, rows)."""

    def entry(i, j):
        return " + ".join(f"a[{p}][{i}] * w[{p}][{q}] * a[{q}][{j}]" for p in range(rows) for q in range(rows))

    return written_out("form", "a, w", matrix_of(columns, columns, entry))


@cache
def symmetric_sum(size: int) -> Callable:
    """Return `add(a, b)`: the symmetric part of a + b, exactly symmetric."""
    places = [(i, j) for i in range(size) for j in range(i + 1)]
    lines = (f"s{i}_{j} = 0.5 * (a[{i}][{j}] + a[{j}][{i}] + b[{i}][{j}] + b[{j}][{i}])" for i, j in places)
    return written_out("add", "a, b", *lines, matrix_of(size, size, lambda i, j: f"s{max(i, j)}_{min(i, j)}"))


@cache
def identity_less(size: int) -> Callable:
    """Return `subtract(a)`: I - a."""
    return written_out(
        "subtract", "a", matrix_of(size, size, lambda i, j: f"{1.0 if i == j else 0.0} - a[{i}][{j}]")
    )


@cache
def innovation(size: int, first: int = 0) -> Callable:
    """Return `subtract(z, y)`: z - y[first:], zero in channels that are NaN in z."""
    entries = (f"z[{i}] - y[{first + i}] if z[{i}] == z[{i}] else 0.0" for i in range(size))
    return written_out("subtract", "z, y", tuple_of(entries))


@cache
def masked(size: int) -> Callable:
    """Return `mask(r, z)`: the covariance r without its correlations to channels that are NaN in z."""

    def entry(i, j):
        here = f"r[{i}][{j}]"
        return here if i == j else f"({here} if z[{i}] == z[{i}] and z[{j}] == z[{j}] else 0.0)"

    return written_out("mask", "r, z", matrix_of(size, size, entry))


def pivoted_factor(size: int, diagonal: str, **names: float) -> Callable:
    """Return `factor(a)`: the lower triangular L of Cholesky's method, row by row, with a diagonal of one's own.

        l_ij = (a_ij - sum_k l_ik l_jk) / l_jj for j < i, the sum over k < j
        d_i = a_ii - sum_k l_ik^2, the sum over k < i, of which l_ii is the root where there is one

    Args:
        size: rows and columns of a.
        diagonal: source of l_ii, in which `{d}` stands for d_i and `{a}` for a_ii.
        names: other names that it uses, with their values.
    """
    lines = []
    for i in range(size):
        for j in range(i + 1):
            rest = "".join(f" - l{i}_{k} * l{j}_{k}" for k in range(j))
            if i == j:
                lines.append(f"d{i} = a[{i}][{i}]{rest}")
                lines.append(f"l{i}_{i} = " + diagonal.format(d=f"d{i}", a=f"a[{i}][{i}]"))
            else:
                lines.append(f"l{i}_{j} = (a[{i}][{j}]{rest}) / l{j}_{j}")
    result = matrix_of(size, size, lambda i, j: f"l{i}_{j}" if j <= i else "0.0")
    return written_out("factor", "a", *lines, result, **names)


@cache
def cholesky_factor(size: int) -> Callable:
    """Return `factor(a)`: the lower triangular L with L L' = a; NaN where a is not positive definite."""
    return pivoted_factor(size, "({d} if {d} > 0.0 else nan) ** 0.5", nan=math.nan)


@cache
def semidefinite_factor(size: int) -> Callable:
    """Return `factor(a)`: the lower triangular L with L L' = a, for a that may be singular.

    A column whose pivot is no more than rounding is zero.
    """
    lines = []
    for j in range(size):
        rest = "".join(f" - l{j}_{k} * l{j}_{k}" for k in range(j))
        lines.append(f"d = a[{j}][{j}]{rest}")
        lines.append(f"l{j}_{j} = d ** 0.5 if not d <= {RESOLUTION} * a[{j}][{j}] else 0.0")
        lines.append(f"r = 1.0 / l{j}_{j} if l{j}_{j} != 0.0 else 0.0")
        for i in range(j + 1, size):
            rest = "".join(f" - l{i}_{k} * l{j}_{k}" for k in range(j))
            lines.append(f"l{i}_{j} = (a[{i}][{j}]{rest}) * r")
    result = matrix_of(size, size, lambda i, j: f"l{i}_{j}" if j <= i else "0.0")
    return written_out("factor", "a", *lines, result)


@cache
def row_solver(rows: int, size: int) -> Callable:
    """Return `solve(b, l)`: b (l l')^-1, for b of shape (rows, size) and l lower triangular."""
    lines = []
    for r in range(rows):
        for i in range(size):
            rest = "".join(f" - l[{i}][{k}] * y{r}_{k}" for k in range(i))
            lines.append(f"y{r}_{i} = (b[{r}][{i}]{rest}) / l[{i}][{i}]")
        for i in reversed(range(size)):
            rest = "".join(f" - l[{k}][{i}] * x{r}_{k}" for k in range(i + 1, size))
            lines.append(f"x{r}_{i} = (y{r}_{i}{rest}) / l[{i}][{i}]")
    return written_out("solve", "b, l", *lines, matrix_of(rows, size, lambda r, i: f"x{r}_{i}"))


@cache
def triangle_divider(rows: int, size: int) -> Callable:
    """Return `divide(b, l)`: b l^-1, for b of shape (rows, size) and l lower triangular."""
    lines = []
    for r in range(rows):
        for i in reversed(range(size)):
            rest = "".join(f" - l[{k}][{i}] * x{r}_{k}" for k in range(i + 1, size))
            lines.append(f"x{r}_{i} = (b[{r}][{i}]{rest}) / l[{i}][{i}]")
    return written_out("divide", "b, l", *lines, matrix_of(rows, size, lambda r, i: f"x{r}_{i}"))


@cache
def forward_solver(size: int) -> Callable:
    """Return `solve(l, v)`: the tuple l^-1 v, for l lower triangular and v of `size` components."""
    lines = []
    for i in range(size):
        rest = "".join(f" - l[{i}][{k}] * y{k}" for k in range(i))
        lines.append(f"y{i} = (v[{i}]{rest}) / l[{i}][{i}]")
    return written_out("solve", "l, v", *lines, tuple_of(f"y{i}" for i in range(size)))


@cache
def innovation_likelihood(size: int) -> Callable:
    """Return `log_likelihood(v, l, z)`: log N(v; 0, l l') over the channels that are not NaN in z."""
    lines = ["total = 0.0"]
    for i in range(size):
        rest = "".join(f" - l[{i}][{k}] * y{k}" for k in range(i))
        lines.append(f"y{i} = (v[{i}]{rest}) / l[{i}][{i}]")
        lines.append(f"if z[{i}] == z[{i}]:")
        lines.append(f"    total -= 0.5 * y{i} * y{i} + log(l[{i}][{i}]) + {0.5 * math.log(2.0 * math.pi)!r}")
    return written_out("log_likelihood", "v, l, z", *lines, "total", log=math.log)


@cache
def square(rows: int, columns: int) -> Callable:
    """Return `square(a)`: a a', exactly symmetric, for a of shape (rows, columns)."""
    lines = (
        f"p{i}_{j} = " + " + ".join(f"a[{i}][{k}] * a[{j}][{k}]" for k in range(columns))
        for i in range(rows)
        for j in range(i + 1)
    )
    return written_out("square", "a", *lines, matrix_of(rows, rows, lambda i, j: f"p{max(i, j)}_{min(i, j)}"))


@cache
def factored_inverse(size: int) -> Callable:
    """Return `invert(l)`: (l l')^-1 = W' W with W = l^-1, exactly symmetric, for l lower triangular."""
    lines = []
    for j in range(size):
        lines.append(f"w{j}_{j} = 1.0 / l[{j}][{j}]")
        for i in range(j + 1, size):
            rest = " + ".join(f"l[{i}][{k}] * w{k}_{j}" for k in range(j, i))
            lines.append(f"w{i}_{j} = -({rest}) / l[{i}][{i}]")
    for i in range(size):
        for j in range(i + 1):
            lines.append(f"p{i}_{j} = " + " + ".join(f"w{k}_{i} * w{k}_{j}" for k in range(i, size)))
    return written_out("invert", "l", *lines, matrix_of(size, size, lambda i, j: f"p{max(i, j)}_{min(i, j)}"))


@cache
def triangular_root(rows: int, columns: int) -> Callable:
    """Return `triangle(a)`: the lower triangular L (rows, rows) with L L' = a a', for a of shape (rows, columns).

    Its rows are those of a in the basis that Gram and Schmidt's method makes of them: the modified method, whose
    L is as accurate as Householder's. Source: Bjorck (1967), "Solving linear least squares problems by
    Gram-Schmidt orthogonalization".
    """
    lines = [f"a{i}_{j} = a[{i}][{j}]" for i in range(rows) for j in range(columns)]
    for i in range(rows):
        lines.append(f"l{i}_{i} = ({' + '.join(f'a{i}_{j} * a{i}_{j}' for j in range(columns))}) ** 0.5")
        lines.append(f"r = 1.0 / l{i}_{i} if l{i}_{i} != 0.0 else 0.0")
        lines += [f"a{i}_{j} = a{i}_{j} * r" for j in range(columns)]
        for k in range(i + 1, rows):
            lines.append(f"l{k}_{i} = " + " + ".join(f"a{i}_{j} * a{k}_{j}" for j in range(columns)))
            lines += [f"a{k}_{j} = a{k}_{j} - l{k}_{i} * a{i}_{j}" for j in range(columns)]
    return written_out(
        "triangle", "a", *lines, matrix_of(rows, rows, lambda i, j: f"l{i}_{j}" if j <= i else "0.0")
    )
