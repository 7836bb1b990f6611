"""Dense matrices as tuples of rows, with every operation written out for its size, and large ones as arrays.

Compiled, small ones stay in registers and cost nanoseconds where a library call costs hundreds. The source of
large ones would grow with the cube of the size, so these are loops instead, compiled once for all sizes. They do
not call BLAS, whose threads would compete with those that work on different trajectories, and whose sums depend on
the machine.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from functools import cache
from typing import NamedTuple, TypeVar

import numpy as np

from thruster_env.core.checks import positive, short_repr
from thruster_env.core.sources import Local, Source, is_array

Parameters = TypeVar("Parameters", bound=NamedTuple)
NEGLIGIBLE = 1e-13  # a pivot below this part of its variance counts as zero in `careful_factor`
RESOLUTION = 1e-15  # of the difference of two float64, relative to them


def scaled(parameters: Parameters, factors: Mapping[str, float], names: Iterable[str]) -> Parameters:
    """Parameters with some fields multiplied by positive factors; ValueError unless these are among the names."""
    if not isinstance(factors, Mapping):
        raise ValueError(f"parameter_factors must map names to factors, but got {short_repr(factors)}")
    unknown = [name for name in factors if name not in names]
    if unknown:
        raise ValueError(f"parameter_factors must name fields of {', '.join(names)}, but got {unknown}")
    changed = {name: getattr(parameters, name) * positive(name, factor) for name, factor in factors.items()}
    return parameters._replace(**changed)


def zero_order_hold(a: np.ndarray, b: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Discrete A_d, B_d of dx/dt = A x + B u for an input held over dt [s], by the matrix exponential."""
    from scipy.linalg import expm

    n, m = b.shape
    powers = expm(np.block([[a, b], [np.zeros((m, n + m))]]) * dt)
    return powers[:n, :n], powers[:n, n:]


def observability(a: np.ndarray, c: np.ndarray) -> tuple[int, float]:
    """Rank and condition number of the observability matrix [C; C A; ...] of a discrete pair (A, C)."""
    matrix = np.vstack([c @ np.linalg.matrix_power(a, k) for k in range(len(a))])
    return int(np.linalg.matrix_rank(matrix)), float(np.linalg.cond(matrix))


def _products_of_rows(a, b, lower):
    """A b', or its lower triangle, in blocks of two rows of a and four of b that share reads.

    Blocks at the ends repeat the last row, so that no further loops are needed for the remainder.
    """
    rows, columns, inner = a.shape[0], b.shape[0], a.shape[1]
    out = np.empty((rows, columns))
    for i in range(0, rows, 2):
        i_1 = min(i + 1, rows - 1)
        for j in range(0, i + 2 if lower else columns, 4):
            j_0, j_1 = min(j, columns - 1), min(j + 1, columns - 1)
            j_2, j_3 = min(j + 2, columns - 1), min(j + 3, columns - 1)
            p_0 = p_1 = p_2 = p_3 = q_0 = q_1 = q_2 = q_3 = 0.0
            for k in range(inner):
                x, y = a[i, k], a[i_1, k]
                p_0 += x * b[j_0, k]
                p_1 += x * b[j_1, k]
                p_2 += x * b[j_2, k]
                p_3 += x * b[j_3, k]
                q_0 += y * b[j_0, k]
                q_1 += y * b[j_1, k]
                q_2 += y * b[j_2, k]
                q_3 += y * b[j_3, k]
            out[i, j_0], out[i, j_1], out[i, j_2], out[i, j_3] = p_0, p_1, p_2, p_3
            out[i_1, j_0], out[i_1, j_1], out[i_1, j_2], out[i_1, j_3] = q_0, q_1, q_2, q_3
    return out


def product_of_rows(a, b):
    """A b'."""
    return _products_of_rows(a, b, False)


def add_product(out, a, b):
    """Add a b to the first rows of an array: four rows of b at a time are added to a row of it."""
    rows, inner, columns = a.shape[0], b.shape[0], b.shape[1]
    in_fours = inner - inner % 4
    for i in range(rows):
        for k in range(0, in_fours, 4):
            x_0, x_1, x_2, x_3 = a[i, k], a[i, k + 1], a[i, k + 2], a[i, k + 3]
            for j in range(columns):
                out[i, j] += x_0 * b[k, j] + x_1 * b[k + 1, j] + x_2 * b[k + 2, j] + x_3 * b[k + 3, j]
        for k in range(in_fours, inner):
            x_0 = a[i, k]
            for j in range(columns):
                out[i, j] += x_0 * b[k, j]


def product(a, b):
    """A b."""
    out = np.zeros((a.shape[0], b.shape[1]))
    add_product(out, a, b)
    return out


def sparse_product(a, b):
    """A b, skipping each four adjacent entries of a that are zero."""
    out = np.zeros((a.shape[0], b.shape[1]))
    for i in range(a.shape[0]):
        for first in range(0, a.shape[1], 4):
            last = min(first + 4, a.shape[1])
            anything = False
            for k in range(first, last):
                anything = anything or a[i, k] != 0.0
            if anything and last == first + 4:
                x_0, x_1, x_2, x_3 = a[i, first], a[i, first + 1], a[i, first + 2], a[i, first + 3]
                for j in range(b.shape[1]):
                    out[i, j] += (
                        x_0 * b[first, j] + x_1 * b[first + 1, j] + x_2 * b[first + 2, j] + x_3 * b[first + 3, j]
                    )
            elif anything:
                for k in range(first, last):
                    for j in range(b.shape[1]):
                        out[i, j] += a[i, k] * b[k, j]
    return out


def deviations(table, first, rows, means, size):
    """Deviations from means (rows,) of `rows` rows of a table, starting at row `first`, and `size` columns."""
    out = np.empty((rows, size))
    for i in range(rows):
        for j in range(size):
            out[i, j] = table[first + i, j] - means[i]
    return out


def weighted_square_of_rows(d, table, weights):
    """The sum of w d d' over columns d with weights w from a row of a table, exactly symmetric."""
    rows, size = d.shape
    scaled = np.empty((rows, size))
    for i in range(rows):
        for j in range(size):
            scaled[i, j] = table[weights, j] * d[i, j]
    out = _products_of_rows(scaled, d, True)
    for i in range(rows):
        for j in range(i):
            out[j, i] = out[i, j]
    return out


def square_of_rows(a):
    """A a', exactly symmetric."""
    out = _products_of_rows(a, a, True)
    for i in range(a.shape[0]):
        for j in range(i):
            out[j, i] = out[i, j]
    return out


def solve_rows(b, factor):
    """B (l l')^-1 for a lower triangular l: forward, then backward substitution for all rows of b at a time."""
    rows, size = b.shape
    turned = b.T.copy()
    for i in range(size):
        for k in range(i):
            x = factor[i, k]
            for r in range(rows):
                turned[i, r] -= x * turned[k, r]
        for r in range(rows):
            turned[i, r] /= factor[i, i]
    for i in range(size - 1, -1, -1):
        for k in range(i + 1, size):
            x = factor[k, i]
            for r in range(rows):
                turned[i, r] -= x * turned[k, r]
        for r in range(rows):
            turned[i, r] /= factor[i, i]
    return turned.T.copy()


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
        return solve_rows
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
    return source.function(source.all_entries(x))


@cache
def vector_solver(size: int) -> Callable:
    """Return `solve(v, l)`: (l l')^-1 v, for v of `size` components and l lower triangular."""
    source = Source("solve", "v, l", result=(size,), v=(size,), l=(size, size), work=size * size)
    y, x = _forward(source, size), source.local("x", size)
    for i in source.reversed(size):
        rest = source.less(y[i], (f"l[{k}][{i}] * {x[k]}" for k in source.range(i + 1, size)))
        source.line(f"{x[i]} = ({rest}) / l[{i}][{i}]")
    return source.function(source.all_entries(x))


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
    return source.function(source.all_entries(x))


def _forward(source: Source, size: int, each: Callable = lambda i, y: None, missing: str = "") -> Local:
    """The numbers y = l^-1 v; `each(i, y)` is called after each, and `missing` is appended to its source."""
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
    return source.function(source.all_entries(_forward(source, size)))


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
    return source.function(source.all_entries(y))


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
        return square_of_rows
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
    shape = rows, columns
    source = Source("triangle", "a", result=(rows, rows), a=shape, work=rows * rows * columns // 2)
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


@cache
def multiplier(rows: int, inner: int, columns: int) -> Callable:
    """Return `multiply(a, b)`: a b for shapes (rows, inner) and (inner, columns)."""
    shapes = {"result": (rows, columns), "a": (rows, inner), "b": (inner, columns)}
    if all(is_array(*shape) for shape in shapes.values()):
        return product
    source = Source("multiply", "a, b", **shapes, work=rows * inner * columns)

    def entry(i, j):
        return source.sum(f"a[{i}][{k}] * b[{k}][{j}]" for k in source.range(inner))

    return source.function(source.matrix(rows, columns, entry))


@cache
def transposed_multiplier(rows: int, inner: int, columns: int) -> Callable:
    """Return `multiply(a, b)`: a b' for shapes (rows, inner) and (columns, inner)."""
    shapes = {"result": (rows, columns), "a": (rows, inner), "b": (columns, inner)}
    if all(is_array(*shape) for shape in shapes.values()):
        return product_of_rows
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
    entry = "0.5 * (a[{0}][{1}] + a[{1}][{0}] + b[{0}][{1}] + b[{1}][{0}])".format
    return source.function(source.symmetric("s", size, entry))


@cache
def innovation(size: int, first: int = 0) -> Callable:
    """Return `subtract(z, y)`: z - y[first:], zero in channels that are NaN in z."""
    source = Source("subtract", "z, y", result=(size,), z=(size,), y=(first + size,))
    return source.function(source.vector(size, lambda i: f"z[{i}] - y[{first + i}] if z[{i}] == z[{i}] else 0.0"))


@cache
def masked(size: int) -> Callable:
    """Return `mask(r, z)`: the covariance r without its correlations to channels that are NaN in z."""
    source = Source("mask", "r, z", result=(size, size), r=(size, size), z=(size,))

    def entry(i, j):
        here = f"r[{i}][{j}]"
        return source.if_same(i, j, here, f"({here} if z[{i}] == z[{i}] and z[{j}] == z[{j}] else 0.0)")

    return source.function(source.matrix(size, size, entry))
