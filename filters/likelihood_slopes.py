"""Derivatives of the equations of an extended Kalman filter along a parameter; see `filters.likelihood`."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from numerics.compiled import inlined, kept_apart
from numerics.derivatives import RELATIVE_STEP
from numerics.matrices import transposed_multiplier
from numerics.sources import Source, entrywise, matrix_of, tuple_of, written_out
from numerics.tuples import matrix_writer, scaled_sum, vector_reader, vector_writer


@cache
def slope_along(rows: int, columns: int, matrix, arguments: str):
    """`slope(curvature, x, scales, d, <arguments>)`: a Jacobian's derivative along d, by central differences."""
    arrays: dict[str, Any] = {"result": (rows, columns), "x": (columns,), "scales": (columns,), "d": (columns,)}
    source = Source("slope", f"curvature, x, scales, d, {arguments}", **arrays)
    if source.loops:
        source.line("h = 1e-300")
        for i in source.range(columns):
            source.line(f"h = max(h, abs(d[{i}]) / (abs(x[{i}]) + scales[{i}]))")
        source.line(f"h = {RELATIVE_STEP} / h")
        source.line(f"above = matrix(move(x, h, d), scales, {arguments})")
        source.line(f"below = matrix(move(x, -h, d), scales, {arguments})")
        entry = source.matrix(rows, columns, lambda i, j: f"(above[{i}, {j}] - below[{i}, {j}]) / (2.0 * h)")
        return source.function(entry, matrix=matrix, move=scaled_sum(columns))
    sizes = ", ".join(f"abs(d[{i}]) / (abs(x[{i}]) + scales[{i}])" for i in range(columns))
    lines = [f"h = {RELATIVE_STEP} / max(1e-300, {sizes})"]
    for name, sign in (("above", "+"), ("below", "-")):
        point = tuple_of(f"x[{i}] {sign} h * d[{i}]" for i in range(columns))
        lines.append(f"{name} = matrix({point}, scales, {arguments})")
    entry = matrix_of(rows, columns, lambda i, j: f"(above[{i}][{j}] - below[{i}][{j}]) / (2.0 * h)")
    return written_out("slope", f"curvature, x, scales, d, {arguments}", *lines, entry, matrix=matrix)


@inlined
def no_curvature(x, scales, u, c):
    """In the place of a curvature, where derivatives are taken along each direction."""
    return 0.0


@cache
def curvature_by_components(rows: int, columns: int, matrix, arguments: str):
    """`curved(x, scales, <arguments>)`: a Jacobian's derivative by each component of x, (columns, rows, columns).

    There are fewer components than directions, of which each parameter has one.
    """
    lines = (
        f"out, unit = np.empty(({columns}, {rows}, {columns})), np.zeros({columns})",
        f"for k in range({columns}):",
        "    unit[k] = 1.0",
        f"    h = {RELATIVE_STEP} * (abs(x[k]) + scales[k])",
        "    d = read(unit)",
        f"    above = matrix(move(x, h, d), scales, {arguments})",
        f"    below = matrix(move(x, -h, d), scales, {arguments})",
        f"    for i in range({rows}):",
        f"        for j in range({columns}):",
        "            out[k, i, j] = (above[i, j] - below[i, j]) / (2.0 * h)",
        "    unit[k] = 0.0",
        "out",
    )
    names = {"matrix": matrix, "move": scaled_sum(columns), "read": vector_reader(columns), "np": np}
    return written_out("curved", f"x, scales, {arguments}", *lines, _loops=True, **names)


@cache
def contraction(rows: int, columns: int):
    """`slope(curvature, x, scales, d, u, c)`: a Jacobian's derivative along d, from that by each component."""
    lines = (
        f"out = np.zeros(({rows}, {columns}))",
        f"for k in range({columns}):",
        f"    for i in range({rows}):",
        f"        for j in range({columns}):",
        "            out[i, j] += d[k] * curvature[k, i, j]",
        "out",
    )
    return written_out("slope", "curvature, x, scales, d, u, c", *lines, _loops=True, np=np)


@cache
def with_transposed(size: int):
    """`add(p, a)`: p + a + a'."""
    shape = size, size
    return entrywise(
        "add", "p, a", shape, lambda i, j: f"p[{i}][{j}] + (a[{i}][{j}] + a[{j}][{i}])", p=shape, a=shape
    )


@cache
def half_product(rows: int, columns: int):
    """`half(c, t, k)`: -(c - t/2) k'."""
    shape = rows, columns
    less = entrywise("less", "c, t", shape, lambda i, j: f"0.5 * t[{i}][{j}] - c[{i}][{j}]", c=shape, t=shape)
    multiply = transposed_multiplier(rows, columns, rows)

    @inlined
    def half(c, t, k):
        return multiply(less(c, t), k)

    return half


@cache
def masked_inverse(size: int):
    """`known(s, z)`: S^-1 with zeros for the channels that are NaN in z, of which S is diagonal."""
    shape = size, size

    def entry(i, j):
        return source.if_same(i, j, f"(s[{i}][{j}] if z[{i}] == z[{i}] else 0.0)", f"s[{i}][{j}]")

    source = Source("known", "s, z", result=shape, s=shape, z=(size,))
    return source.function(source.matrix(size, size, entry))


@cache
def present_rows_of(rows: int, columns: int):
    """`keep(h, z)`: h with zeros in the rows of channels that are NaN in z."""
    shape = rows, columns
    return entrywise(
        "keep", "h, z", shape, lambda i, j: f"h[{i}][{j}] if z[{i}] == z[{i}] else 0.0", h=shape, z=(rows,)
    )


@cache
def log_likelihood_slope(size: int):
    """`slope(w, e, dy, ds)`: of log N(v; 0, S), where v changes by -dy and S by ds.

    It is -1/2 tr(S^-1 dS) + w' dy + 1/2 w' dS w with w = S^-1 v and e = S^-1, zero where no channel is measured.
    """
    matrix, vector = (size, size), (size,)
    source = Source("slope", "w, e, dy, ds", work=size * size, w=vector, e=matrix, dy=vector, ds=matrix)
    products = (
        f"(w[{i}] * w[{j}] - e[{i}][{j}]) * ds[{i}][{j}]" for i in source.range(size) for j in source.range(size)
    )
    square = source.sum(products)
    shift = source.sum(f"w[{i}] * dy[{i}]" for i in source.range(size))
    return source.function(f"0.5 * ({square}) + {shift}")


@cache
def terms_writer(size: int):
    """`note(row, dy, ds)`: what the information takes of one parameter, kept in row[: size + size^2]."""
    store, store_matrix = vector_writer(size), matrix_writer(size, size, size)

    @inlined
    def note(row, dy, ds):
        store(row, dy)
        store_matrix(row, ds)

    return note


@inlined
def no_terms(row, dy, ds):
    """In place of `terms_writer`, where no information is asked for."""


@cache
def information_sum(size: int):
    """`add(out, terms, s_inverse)`: add the information of a measurement on the parameters, (p, p), to out.

    It is dy_i' S^-1 dy_j + 1/2 tr(S^-1 dS_i S^-1 dS_j) with the terms (p, size + size^2) of `terms_writer`.
    """
    store = matrix_writer(size, size)

    @kept_apart
    def add(out, terms, s_inverse):
        inverse = np.empty(size * size)
        store(inverse, s_inverse)
        weighted = np.zeros((terms.shape[0], size + size * size))
        for p in range(terms.shape[0]):
            for i in range(size):
                for j in range(size):
                    e = inverse[i * size + j]
                    weighted[p, i] += e * terms[p, j]
                    for k in range(size):
                        weighted[p, size + i * size + k] += e * terms[p, size + j * size + k]
        for p in range(terms.shape[0]):
            for q in range(p + 1):
                total = 0.0
                for i in range(size):
                    total += terms[p, i] * weighted[q, i]
                    for j in range(size):
                        a, b = weighted[p, size + i * size + j], weighted[q, size + j * size + i]
                        total += 0.5 * a * b
                out[p, q] += total
                if q < p:
                    out[q, p] += total

    return add


@inlined
def no_information(out, terms, s_inverse):
    """In place of `information_sum`, where no information is asked for."""
