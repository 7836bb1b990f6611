"""Simplification of operations on Numbers: of constants, with zeros and ones, with signs.

Some entries of a model's matrices are zeros and ones when it is traced. Products with them vanish here, so no
program multiplies by zero: little remains of A P A' with a sparse A.

A number along which derivatives are taken is not taken apart (`Graph.whole`): if a - b moves, -(a - b) does not
become b - a, which would not depend on it.

Slopes ask for it: only a root that may be zero, or a quotient whose divisor may be infinite, needs a choice.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from thruster_env.graphs.graphs import Number

GROWING = frozenset("exp exp2 expm1 log log2 log10 log1p sinh cosh arctanh pow".split())
"""Operations whose results may be infinite for numbers of usual size."""
UNKNOWN, NEVER_NEGATIVE, POSITIVE = range(3)


def overflow_of(operation: str, of: Sequence[Number]) -> bool:
    """Whether the result of an operation, or one of its arguments, may be infinite for numbers of usual size."""
    divided = operation == "/" and of[1].sign != POSITIVE and not of[1].value
    return divided or operation in GROWING or any([a.may_overflow for a in of])


def sign_of(operation: str, of: Sequence[Number], value: float | None) -> int:
    """UNKNOWN, NEVER_NEGATIVE or POSITIVE, of the result of an operation on numbers; POSITIVE is never zero."""
    if operation == "constant":
        return POSITIVE if value > 0.0 else NEVER_NEGATIVE if value == 0.0 else UNKNOWN  # type: ignore[operator]
    if operation == "+":
        return max(of[0].sign, of[1].sign) if of[0].sign and of[1].sign else UNKNOWN
    if operation == "*":
        return max(NEVER_NEGATIVE, of[0].sign) if of[0] is of[1] else min(of[0].sign, of[1].sign)
    if operation in ("sqrt", "abs", "hypot"):
        return max(NEVER_NEGATIVE, *[a.sign for a in of])
    if operation in ("exp", "exp2", "erfc"):
        return NEVER_NEGATIVE
    return {"cosh": POSITIVE, "cbrt": of[0].sign if of else UNKNOWN}.get(operation, UNKNOWN)


def as_number(a: Number) -> Number:
    """A number, of a condition 1.0 where it holds and 0.0 where it does not."""
    if not a.is_condition:
        return a
    return a.graph.make("where", a, a.graph.constant(1.0), a.graph.constant(0.0))


def worked_out(operation: str, *numbers: Number) -> Number:
    """An operation of one or two numbers; that of constants is done."""
    numbers = tuple(map(as_number, numbers))
    values, graph = [number.value for number in numbers], numbers[0].graph
    if None in values:
        return graph.make(operation, *numbers)
    try:
        return graph.constant((_OF_CONSTANTS.get(operation) or getattr(math, operation))(*values))
    except (ValueError, ArithmeticError):  # where machine code has NaN or infinity
        return graph.make(operation, *numbers)


_OF_CONSTANTS: dict[str, Callable] = {
    "negative": operator.neg,
    "abs": abs,
    "arctan": math.atan,
    "arctan2": math.atan2,
    "arcsinh": math.asinh,
    "arccosh": math.acosh,
    "arctanh": math.atanh,
    "pow": math.pow,
    "rint": round,
}


UNDEFINED = GROWING | {"/", "sqrt", "fmod", "tan", "arccosh"}
"""Operations that make NaN or infinity of usual numbers."""


def _may_have_no_value(a: Number) -> bool:
    """Whether a number may be NaN or infinite for finite arguments: then zero times it is not zero."""
    waiting, known = [a], {a.place}
    while waiting:
        number = waiting.pop()
        if number.operation in UNDEFINED:
            return True
        new = [other for other in number.of if other.place not in known]
        known |= {other.place for other in new}
        waiting += new
    return False


def _is(a: Number, operation: str) -> bool:
    return a.operation == operation and a.place not in a.graph.whole


def negative(a: Number) -> Number:
    """-a."""
    if _is(a, "-"):
        return difference(a.arguments[1], a.arguments[0])
    return a.arguments[0] if _is(a, "negative") else worked_out("negative", a)


def total(a: Number, b: Number) -> Number:
    """A sum: nothing is added to zero, and of a negative number the difference is taken."""
    if a.value is not None and b.value is not None:
        return a.graph.constant(a.value + b.value)
    if a.value == 0.0 or b.value == 0.0:
        return b if a.value == 0.0 else a
    if _is(b, "negative"):
        return difference(a, b.arguments[0])
    return difference(b, a.arguments[0]) if _is(a, "negative") else a.graph.make("+", a, b)


def difference(a: Number, b: Number) -> Number:
    """A difference, as a sum has it."""
    if a.value is not None and b.value is not None:
        return a.graph.constant(a.value - b.value)
    if b.value == 0.0:
        return a
    if _is(b, "negative"):
        return total(a, b.arguments[0])
    return negative(b) if a.value == 0.0 else a.graph.make("-", a, b)


def product(a: Number, b: Number) -> Number:
    """A product: zero with zero, the other one with one; signs stand before it."""
    if a.value is not None and b.value is not None:
        return a.graph.constant(a.value * b.value)
    for factor, other in ((a, b), (b, a)):
        if factor.value is not None:
            if factor.value == 0.0 and not (a.graph.exact and _may_have_no_value(other)):
                return factor
            if abs(factor.value) == 1.0:
                return other if factor.value > 0 else negative(other)
        elif _is(factor, "negative"):
            return negative(product(factor.arguments[0], other))
    return a.graph.make("*", a, b)


def quotient(a: Number, b: Number) -> Number:
    """A quotient, as the product with the reciprocal: of each divisor there is one."""
    if a.value == 0.0 or b.value == 1.0:
        return a
    if b.value is not None:
        return a.graph.make("/", a, b) if b.value == 0.0 else product(a, a.graph.constant(1.0 / b.value))
    return b.graph.make("/", a, b) if a.value == 1.0 else product(a, quotient(b.graph.constant(1.0), b))


def divided(a: Number, b: Number) -> Number:
    """A quotient as Python has it; the reciprocal of a power of two is one, too."""
    if b.value is None or b.value == 0.0:
        return a.graph.make("/", a, b)
    if a.value is not None:
        return a.graph.constant(a.value / b.value)
    if abs(math.frexp(b.value)[0]) == 0.5 and math.isfinite(1.0 / b.value):
        return product(a, a.graph.constant(1.0 / b.value))
    return a.graph.make("/", a, b)


def modulus(a: Number, b: Number) -> Number:
    """The rest a % b, with the sign of b, as Python and NumPy have it."""
    if b.value == 1.0:
        return difference(a, worked_out("floor", a))
    rest = worked_out("fmod", a, b)
    return _folded_choice(_turns(rest, b), total(rest, b), rest)


def floor_quotient(a: Number, b: Number) -> Number:
    """The quotient a // b, a whole number, as CPython and NumPy find it: 1.0 // 0.1 is 9, though 1.0/0.1 is 10."""
    if b.value == 0.0:
        return divided(a, b)
    rest = worked_out("fmod", a, b)
    parts = divided(difference(a, rest), b)
    parts = _folded_choice(_turns(rest, b), difference(parts, a.graph.constant(1.0)), parts)
    floored = worked_out("floor", parts)
    quotient = _folded_choice(difference(parts, floored) > 0.5, total(floored, a.graph.constant(1.0)), floored)
    return quotient if b.value is not None else _folded_choice(b == 0.0, divided(a, b), quotient)


def _turns(rest: Number, b: Number) -> Number | bool:
    """Whether a rest with the sign of the dividend is not zero, and has not that of the divisor."""
    if b.value is not None:
        return rest < 0.0 if b.value > 0.0 else rest > 0.0
    return (rest < 0.0) & (b > 0.0) | (rest > 0.0) & (b < 0.0)


def _folded_choice(condition: Number | bool, a: Number, b: Number) -> Number:
    if isinstance(condition, bool):
        return a if condition else b
    return a if a is b else a.graph.make("where", condition, a, b)


SMALLEST = float(np.finfo(np.float32).tiny)  # normal


def as_single(value: float) -> float:
    """The nearest float32; of a number that is too small for one the smallest, which keeps a divisor from zero."""
    if 0.0 < abs(value) < SMALLEST:
        return math.copysign(SMALLEST, value)
    with np.errstate(over="ignore"):
        return float(np.float32(value))
