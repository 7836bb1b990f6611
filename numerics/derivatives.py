"""Jacobians of functions on tuples: analytic where given, else by complex steps or central differences."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

from numerics.angles import NAMES, short_way
from numerics.compiled import inlined
from numerics.pickling import makes_functions
from numerics.tuples import matrix_of, tuple_of, written_out

RELATIVE_STEP = 6e-6  # cube root of the float64 resolution balances truncation and rounding
COMPLEX_STEP = 1e-100  # nothing is subtracted, so it may be as small as one likes


@makes_functions
def complex_step(function: Callable, rows: int, columns: int, arguments: str) -> Callable:
    """Return `jacobian(x, <arguments>)`: df/dx_j = Im f(x + i h e_j) / h, to the last digit.

    Args:
        function: an analytic function of a tuple of `columns` components and the arguments, made of arithmetic and
            numpy functions that take complex numbers. (`abs`, comparisons and `math` are not among them: `abs`
            would give a wrong derivative without a word.)
        rows: number of components of its result.
        columns: number of components of x.
        arguments: names of the other arguments, comma separated.

    Source: Squire, Trapp (1998), "Using complex variables to estimate derivatives of real functions", SIAM Review.
    """
    lines = []
    for j in range(columns):
        point = tuple_of(f"complex(x[{i}], {COMPLEX_STEP if i == j else 0.0})" for i in range(columns))
        lines.append(f"y{j} = function({point}, {arguments})")
    source = matrix_of(rows, columns, lambda i, j: f"(0j + y{j}[{i}]).imag / {COMPLEX_STEP}")
    made = written_out("jacobian", f"x, {arguments}", *lines, source, function=inlined(function))
    made.differentiates = function
    return made


@cache
def jacobian(
    function: Callable,
    analytic: Callable | None,
    rows: int,
    columns: int,
    arguments: str,
    angles: tuple[bool, ...] = (),
) -> Callable:
    """Return `jacobian(x, scales, <arguments>)`: d function/dx as a tuple of rows.

    Args:
        function: takes a tuple of `columns` components and the arguments, returns a tuple of `rows`.
        analytic: its Jacobian if known, a function of x and the arguments.
        rows: number of components of the result.
        columns: number of components of x.
        arguments: names of the other arguments, comma separated.
        angles: which components of the result are angles, so that differences of them go the short way round.

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

    def slope(i, j):
        return short_way(f"(above{j}[{i}] - below{j}[{i}])", i, angles) + f" / (2.0 * h{j})"

    return written_out(
        "jacobian", signature, *lines, matrix_of(rows, columns, slope), function=inlined(function), **NAMES
    )
