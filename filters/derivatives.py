"""Jacobians of functions on tuples: analytic where given, else central differences."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

from thruster_env.compiled import inlined
from thruster_env.components import matrix_of, tuple_of, written_out

RELATIVE_STEP = 6e-6  # cube root of the float64 resolution balances truncation and rounding


@cache
def jacobian(function: Callable, analytic: Callable | None, rows: int, columns: int, arguments: str) -> Callable:
    """Return `jacobian(x, scales, <arguments>)`: d function/dx as a tuple of rows.

    Args:
        function: takes a tuple of `columns` components and the arguments, returns a tuple of `rows`.
        analytic: its Jacobian if known, a function of x and the arguments.
        rows: number of components of the result.
        columns: number of components of x.
        arguments: names of the other arguments, comma separated.

    The steps of central differences are relative to |x| + scales, both tuples of `columns` components.
    """
    signature = f"x, scales, {arguments}"
    if analytic is not None:
        return written_out("jacobian", signature, f"analytic(x, {arguments})", analytic=inlined(analytic))
    lines = []
    for j in range(columns):
        lines.append(f"h{j} = {RELATIVE_STEP} * (abs(x[{j}]) + scales[{j}])")
        for name, sign in (("above", "+"), ("below", "-")):
            point = tuple_of(f"x[{i}] {sign} h{j}" if i == j else f"x[{i}]" for i in range(columns))
            lines.append(f"{name}{j} = function({point}, {arguments})")
    source = matrix_of(rows, columns, lambda i, j: f"(above{j}[{i}] - below{j}[{i}]) / (2.0 * h{j})")
    return written_out("jacobian", signature, *lines, source, function=inlined(function))
