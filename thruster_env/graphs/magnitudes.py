"""What is known of the size of a number when a graph gets it: whether it may be infinite, whether it can be zero.

Slopes ask for it: only a root that may be zero, or a quotient whose divisor may be infinite, needs a choice.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from thruster_env.graphs.graphs import Number

GROWING = frozenset("exp exp2 expm1 log log2 log10 log1p sinh cosh arctanh pow".split())
"""Operations whose results may be infinite for numbers of usual size."""
UNKNOWN, NEVER_NEGATIVE, POSITIVE = range(3)


def overflow_of(operation: str, of: Sequence[Number]) -> bool:
    """Whether the result of an operation may be infinite for numbers of usual size, or is made of such."""
    divided = operation == "/" and of[1].sign != POSITIVE and not of[1].value
    return divided or operation in GROWING or any([one.may_overflow for one in of])


def sign_of(operation: str, of: Sequence[Number], value: float | None) -> int:
    """UNKNOWN, NEVER_NEGATIVE or POSITIVE, of the result of an operation on numbers; POSITIVE is never zero."""
    if operation == "constant":
        return POSITIVE if value > 0.0 else NEVER_NEGATIVE if value == 0.0 else UNKNOWN  # type: ignore[operator]
    if operation == "+":
        return max(of[0].sign, of[1].sign) if of[0].sign and of[1].sign else UNKNOWN
    if operation == "*":
        return max(NEVER_NEGATIVE, of[0].sign) if of[0] is of[1] else min(of[0].sign, of[1].sign)
    if operation in ("sqrt", "abs", "hypot"):
        return max(NEVER_NEGATIVE, *[one.sign for one in of])
    if operation in ("exp", "exp2", "erfc"):
        return NEVER_NEGATIVE
    return {"cosh": POSITIVE, "cbrt": of[0].sign if of else UNKNOWN}.get(operation, UNKNOWN)
