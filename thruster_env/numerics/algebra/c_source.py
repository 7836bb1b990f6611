"""A program as statements of C99, which read arrays, work out numbers, and store them.

    const double t0 = x[0];
    const double t1 = 0.5 * t0;
    x[0] = t1;

Constants stand where they are used, with as many digits as tell them from their neighbours.
"""

from __future__ import annotations

import math

import numpy as np

from thruster_env.numerics.algebra.graphs import Number
from thruster_env.numerics.algebra.precision import as_single
from thruster_env.numerics.algebra.programs import DECISIONS, Program

OF_TWO = {name: name for name in ("+", "-", "*", "/", "<", "<=", ">", ">=", "==", "!=")} | {"and": "&&"}
OTHER_NAMES = {"abs": "fabs", "arctan": "atan", "arctan2": "atan2"}
"""Functions of math.h that have other names in NumPy."""


def statements_of(program: Program, single: bool = False) -> list[str]:
    """Statements that run a program; the arrays' names in its places are expressions of C.

    Args:
        program: reads come first, stores last, so results may lie where arguments do.
        single: whether all numbers are floats, not doubles.
    """
    kind = "float" if single else "double"
    names: dict[int, str] = {}
    lines = []
    for k, (place, one) in enumerate(program.reads):
        names[one.place] = f"t{k}"
        lines.append(f"const {kind} t{k} = {place};")
    for one in program.works:
        if one.value is not None:
            names[one.place] = literal(one.value, single)
        else:
            name = names[one.place] = f"t{len(lines)}"
            whose = "int" if one.operation in DECISIONS else kind
            lines.append(f"const {whose} {name} = {_expression(one, names, single)};")
    return lines + [f"{place} = {names[one.place]};" for place, one in program.stores]


def _expression(one: Number, names: dict[int, str], single: bool) -> str:
    values = [names[a.place] if isinstance(a, Number) else str(int(a)) for a in one.arguments]
    if one.operation == "==" and values[0] == values[1]:
        return f"!isnan({values[0]})"
    if one.operation in OF_TWO:
        return f"{values[0]} {OF_TWO[one.operation]} {values[1]}"
    if one.operation == "negative":
        return f"-{values[0]}"
    if one.operation == "where":
        return f"{values[0]} ? {values[1]} : {values[2]}"
    return f"{OTHER_NAMES.get(one.operation, one.operation)}{'f' * single}({', '.join(values)})"


def literal(value: float, single: bool = False) -> str:
    """A number as C writes it; negative ones in brackets."""
    if math.isnan(value):
        return "NAN"
    value = as_single(value) if single else float(value)
    text = "INFINITY" if math.isinf(value) else str(np.float32(abs(value))) + "f" if single else repr(abs(value))
    return f"(-{text})" if value < 0 else text
