"""What pages say of numbers: reciprocals, conditions and choices, traces, how many channels are seen.

A choice works out both sides. So a page that divides guards its divisor, not its quotient.
"""

from __future__ import annotations

import numpy as np

from numerics.algebra.graphs import where
from numerics.algebra.matrices import Matrix, operation, through


def ratio(a, b):
    """A matrix or number a, divided by the number b."""
    return a * (reciprocal(b) if isinstance(b, Matrix) else 1.0 / b)


@operation(lambda shape: ())
def reciprocal(a):
    """1/a of a number."""
    return 1.0 / a


@operation(lambda a, value: ())
def exceeds(a, value):
    """Whether a number is larger than one that is known now."""
    return a > value


@operation(lambda a: ())
def is_number(a):
    """Whether a number is one, and not NaN."""
    return a == a


@operation(lambda *shapes: shapes[1], lambda condition, a, b: a.symmetric and b.symmetric)
def choose(condition, a, b):
    """`a` if the condition holds, else `b`: two numbers, or two matrices of the same shape."""
    if not np.shape(a):
        return where(condition, a, b)
    pairs = zip(np.ravel(a), np.ravel(b), strict=True)
    return np.array([where(condition, one, other) for one, other in pairs], dtype=np.result_type(a, b)).reshape(
        a.shape
    )


@operation(lambda shape: ())
def trace(a):
    """The sum of the diagonal."""
    return sum(a[i, i] for i in range(len(a)))


@operation(lambda shape: ())
def count(seen):
    """How many channels are seen."""
    return sum(where(one, 1.0, 0.0) for one in seen)


def constant(value: float, like):
    """A number that is known, beside a number `like` that may not be."""
    return shifted(like * 0.0, float(value)) if isinstance(like, Matrix) else value


@operation(lambda a, value: a)
def shifted(a, value):
    """A number plus one that is known now."""
    return a + value


@reciprocal.derivative
def _of_reciprocal(result, arguments, slopes):
    return through(lambda slope: slope * result * result * -1.0, slopes[0])


@shifted.derivative
def _of_shifted(result, arguments, slopes):
    return slopes[0]


@trace.derivative
def _of_trace(result, arguments, slopes):
    return through(trace, slopes[0])


@choose.derivative
def _of_choice(result, arguments, slopes):
    condition, *values = arguments
    moves = (a * 0.0 if slope is None else slope for a, slope in zip(values, slopes[1:], strict=True))
    return choose(condition, *moves)


@exceeds.derivative
@is_number.derivative
@count.derivative
def _of_decision(result, arguments, slopes):
    """Of what is constant but for jumps."""
    return None
