"""Triangular factors of matrices of every size, and solutions with them; see `thruster_env.core.matrices`."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache

from thruster_env.core import arrays
from thruster_env.core.sources import Local, Source, is_array

NEGLIGIBLE = 1e-13  # a pivot below this part of its variance counts as zero in `careful_factor`
RESOLUTION = 1e-15  # of the difference of two float64, relative to them


def pivoted_factor(size: int, diagonal: str, **names: float) -> Callable:
    """Return `factor(a)`: the lower triangular L of Cholesky's method, row by row, with a diagonal of one's own.

        l_ij = (a_ij - sum_k l_ik l_jk) / l_jj for j < i, the sum over k < j
        d_i = a_ii - sum_k l_ik^2, the sum over k < i, of which l_ii is the root where there is one

    Args:
        size: rows and columns of a.
        diagonal: source of l_ii, in which `{d}` stands for d_i and `{a}` for a_ii.
        names: other names that it uses, with their values.
    """
    source = Source("factor", "a", result=(size, size), a=(size, size), work=size**3 // 6)
    root, d = source.local("l", size, size), source.local("d", size)
    for i in source.range(size):
        for j in source.range(i):
            rest = source.less(f"a[{i}][{j}]", (f"{root[i, k]} * {root[j, k]}" for k in source.range(j)))
            source.line(f"{root[i, j]} = ({rest}) / {root[j, j]}")
        source.line(
            f"{d[i]} = " + source.less(f"a[{i}][{i}]", (f"{root[i, k]} * {root[i, k]}" for k in source.range(i)))
        )
        source.line(f"{root[i, i]} = " + diagonal.format(d=d[i], a=f"a[{i}][{i}]"))
    return source.function(source.lower(root), **names)


@cache
def cholesky_factor(size: int) -> Callable:
    """Return `factor(a)`: the lower triangular L with L L' = a; NaN where a is not positive definite."""
    return pivoted_factor(size, "({d} if {d} > 0.0 else nan) ** 0.5", nan=math.nan)


@cache
def careful_factor(size: int) -> Callable:
    """Return `factor(a)`: the lower triangular L of a positive semidefinite a, for `row_solver`.

    Where a pivot is zero the diagonal of L is infinite, so that solving gives zero there.
    """
    return pivoted_factor(size, f"{{d}} ** 0.5 if {{d}} > {NEGLIGIBLE} * {{a}} else infinity", infinity=math.inf)


@cache
def semidefinite_factor(size: int) -> Callable:
    """Return `factor(a)`: the lower triangular L with L L' = a, for a that may be singular.

    A column whose pivot is no more than rounding is zero.
    """
    source = Source("factor", "a", result=(size, size), a=(size, size), work=size**3 // 6)
    root = source.local("l", size, size)
    for j in source.range(size):
        source.line(
            "d = " + source.less(f"a[{j}][{j}]", (f"{root[j, k]} * {root[j, k]}" for k in source.range(j)))
        )
        source.line(f"{root[j, j]} = d ** 0.5 if not d <= {RESOLUTION} * a[{j}][{j}] else 0.0")
        source.line(f"r = 1.0 / {root[j, j]} if {root[j, j]} != 0.0 else 0.0")
        for i in source.range(j + 1, size):
            rest = source.less(f"a[{i}][{j}]", (f"{root[i, k]} * {root[j, k]}" for k in source.range(j)))
            source.line(f"{root[i, j]} = ({rest}) * r")
    return source.function(source.lower(root))


@cache
def row_solver(rows: int, size: int) -> Callable:
    """Return `solve(b, l)`: b (l l')^-1, for b of shape (rows, size) and l lower triangular."""
    if is_array(rows, size) and is_array(size, size):
        return arrays.solve_rows
    shape = rows, size
    source = Source("solve", "b, l", result=shape, b=shape, l=(size, size), work=rows * size * size)
    y, x = source.local("y", rows, size), source.local("x", rows, size)
    for r in source.range(rows):
        for i in source.range(size):
            rest = source.less(f"b[{r}][{i}]", (f"l[{i}][{k}] * {y[r, k]}" for k in source.range(i)))
            source.line(f"{y[r, i]} = ({rest}) / l[{i}][{i}]")
        for i in source.reversed(size):
            rest = source.less(y[r, i], (f"l[{k}][{i}] * {x[r, k]}" for k in source.range(i + 1, size)))
            source.line(f"{x[r, i]} = ({rest}) / l[{i}][{i}]")
    return source.function(source.whole(x))


@cache
def vector_solver(size: int) -> Callable:
    """Return `solve(v, l)`: (l l')^-1 v, for v of `size` components and l lower triangular."""
    source = Source("solve", "v, l", result=(size,), v=(size,), l=(size, size), work=size * size)
    y, x = _forward(source, size), source.local("x", size)
    for i in source.reversed(size):
        rest = source.less(y[i], (f"l[{k}][{i}] * {x[k]}" for k in source.range(i + 1, size)))
        source.line(f"{x[i]} = ({rest}) / l[{i}][{i}]")
    return source.function(source.whole(x))


@cache
def triangle_divider(rows: int, size: int) -> Callable:
    """Return `divide(b, l)`: b l^-1, for b of shape (rows, size) and l lower triangular."""
    shape = rows, size
    source = Source("divide", "b, l", result=shape, b=shape, l=(size, size), work=rows * size * size // 2)
    x = source.local("x", rows, size)
    for r in source.range(rows):
        for i in source.reversed(size):
            rest = source.less(f"b[{r}][{i}]", (f"l[{k}][{i}] * {x[r, k]}" for k in source.range(i + 1, size)))
            source.line(f"{x[r, i]} = ({rest}) / l[{i}][{i}]")
    return source.function(source.whole(x))


def _forward(source: Source, size: int, each: Callable = lambda i, y: None, missing: str = "") -> Local:
    """The numbers y = l^-1 v; `each(i, y)` is called behind every one, and `missing` follows its source."""
    y = source.local("y", size)
    for i in source.range(size):
        rest = source.less(f"v[{i}]", (f"l[{i}][{k}] * {y[k]}" for k in source.range(i)))
        source.line(f"{y[i]} = ({rest}) / l[{i}][{i}]" + missing.format(i=i))
        each(i, y)
    return y


@cache
def forward_solver(size: int) -> Callable:
    """Return `solve(l, v)`: the tuple l^-1 v, for l lower triangular and v of `size` components."""
    source = Source("solve", "l, v", result=(size,), l=(size, size), v=(size,), work=size * size // 2)
    return source.function(source.whole(_forward(source, size)))


@cache
def column_solver(size: int, columns: int) -> Callable:
    """Return `solve(l, b)`: l^-1 b, for l lower triangular and b of shape (size, columns)."""
    shape = size, columns
    source = Source("solve", "l, b", result=shape, l=(size, size), b=shape, work=size * size * columns // 2)
    y = source.local("y", size, columns)
    for c in source.range(columns):
        for i in source.range(size):
            rest = source.less(f"b[{i}][{c}]", (f"l[{i}][{k}] * {y[k, c]}" for k in source.range(i)))
            source.line(f"{y[i, c]} = ({rest}) / l[{i}][{i}]")
    return source.function(source.whole(y))


@cache
def innovation_likelihood(size: int) -> Callable:
    """Return `log_likelihood(v, l, z)`: log N(v; 0, l l') over the channels that are not NaN in z."""
    shapes = {"v": (size,), "l": (size, size), "z": (size,)}
    source = Source("log_likelihood", "v, l, z", **shapes, work=size * size // 2)
    source.line("total = 0.0")

    def add(i, y):
        for _ in source.inside(f"if z[{i}] == z[{i}]:"):
            half = f"0.5 * {y[i]} * {y[i]} + log(l[{i}][{i}])"
            source.line(f"total -= {half} + {0.5 * math.log(2.0 * math.pi)!r}")

    _forward(source, size, add)
    return source.function("total", log=math.log)


@cache
def square(rows: int, columns: int) -> Callable:
    """Return `square(a)`: a a', exactly symmetric, for a of shape (rows, columns)."""
    if is_array(rows, rows) and is_array(rows, columns):
        return arrays.square_of_rows
    work = rows * rows * columns // 2
    source = Source("square", "a", result=(rows, rows), a=(rows, columns), work=work)

    def entry(i, j):
        return source.sum(f"a[{i}][{k}] * a[{j}][{k}]" for k in source.range(columns))

    return source.function(source.symmetric("p", rows, entry))


@cache
def factored_inverse(size: int) -> Callable:
    """Return `invert(l)`: (l l')^-1 = W' W with W = l^-1, exactly symmetric, for l lower triangular."""
    source = Source("invert", "l", result=(size, size), l=(size, size), work=size**3 // 3)
    w = source.local("w", size, size)
    for j in source.range(size):
        source.line(f"{w[j, j]} = 1.0 / l[{j}][{j}]")
        for i in source.range(j + 1, size):
            rest = source.sum(f"l[{i}][{k}] * {w[k, j]}" for k in source.range(j, i))
            source.line(f"{w[i, j]} = -({rest}) / l[{i}][{i}]")

    def entry(i, j):
        return source.sum(f"{w[k, i]} * {w[k, j]}" for k in source.range(i, size))

    return source.function(source.symmetric("p", size, entry))


@cache
def triangular_root(rows: int, columns: int) -> Callable:
    """Return `triangle(a)`: the lower triangular L (rows, rows) with L L' = a a', for a of shape (rows, columns).

    Its rows are those of a in the basis that Gram and Schmidt's method makes of them: the modified method, whose
    L is as accurate as Householder's. Source: Bjorck (1967), "Solving linear least squares problems by
    Gram-Schmidt orthogonalization".
    """
    given = rows, columns
    source = Source("triangle", "a", result=(rows, rows), a=given, work=rows * rows * columns // 2)
    b, root = source.local("b", rows, columns), source.local("l", rows, rows)
    for i in source.range(rows):
        for j in source.range(columns):
            source.line(f"{b[i, j]} = a[{i}][{j}]")
    for i in source.range(rows):
        total = source.sum(f"{b[i, j]} * {b[i, j]}" for j in source.range(columns))
        source.line(f"{root[i, i]} = ({total}) ** 0.5")
        source.line(f"r = 1.0 / {root[i, i]} if {root[i, i]} != 0.0 else 0.0")
        for j in source.range(columns):
            source.line(f"{b[i, j]} = {b[i, j]} * r")
        for k in source.range(i + 1, rows):
            total = source.sum(f"{b[i, j]} * {b[k, j]}" for j in source.range(columns))
            source.line(f"{root[k, i]} = {total}")
            for j in source.range(columns):
                source.line(f"{b[k, j]} = {b[k, j]} - {root[k, i]} * {b[i, j]}")
    return source.function(source.lower(root))
