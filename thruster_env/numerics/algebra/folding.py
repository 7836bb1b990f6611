"""Operations on Numbers that make others than themselves: of constants, with zeros and ones, with signs.

A matrix of a model has zeros and ones in places that are known when it is traced. Products with them vanish
here, so that no program multiplies by zero: of an A P A' with a sparse A little is left.

Numbers along which something is to be differentiated are left whole (`Graph.whole`): of a - b that moves
-(a - b) stays what it is, for b - a would not show that it moves.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from thruster_env.numerics.algebra.graphs import Number


def worked_out(operation: str, *numbers: Number) -> Number:
    """An operation of one or two numbers; that of constants is done."""
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
    "pow": math.pow,
}


def _is(a: Number, operation: str) -> bool:
    """Whether an operation made a number that may be taken apart."""
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
    for one, other in ((a, b), (b, a)):
        if one.value is not None:
            if one.value == 0.0:
                return one
            if abs(one.value) == 1.0:
                return other if one.value > 0 else negative(other)
        elif _is(one, "negative"):
            return negative(product(one.arguments[0], other))
    return a.graph.make("*", a, b)


def quotient(a: Number, b: Number) -> Number:
    """A quotient, as the product with the reciprocal: of each divisor there is one."""
    if a.value == 0.0 or b.value == 1.0:
        return a
    if b.value is not None:
        return a.graph.make("/", a, b) if b.value == 0.0 else product(a, a.graph.constant(1.0 / b.value))
    return b.graph.make("/", a, b) if a.value == 1.0 else product(a, quotient(b.graph.constant(1.0), b))
