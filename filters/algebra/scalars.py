"""Operations on numbers: conditions and choices, traces, the count of measured channels; and slopes of graphs.

A choice computes both sides. So a page that divides guards its divisor, not its quotient.

Slopes are Matrices of the same graph as values. So operations that they share, such as a gain, a quotient S^-1 v
or the product P H', are evaluated once. A slope of None is zero.
"""

from __future__ import annotations

import operator
from collections.abc import Mapping, Sequence

import numpy as np

from filters.algebra.matrices import (
    Matrix,
    entries_product,
    in_order,
    magnitude,
    operation,
    plus,
    power,
    reciprocal,
    same,
    shifted,
    through,
)
from thruster_env.graphs.graphs import where


def _by_entries(function, *arrays):
    """A function of numbers, applied to the entries of arrays."""
    with np.errstate(invalid="ignore"):
        result = np.frompyfunc(function, len(arrays), 1)(*arrays)
    return np.array(result.tolist()) if np.ndim(result) else result


@operation(same)
def exceeds(a, value):
    """Whether a number, or each entry, is larger than the float `value`."""
    return _by_entries(operator.gt, a, value)


@operation(lambda a: ())
def is_number(a):
    """Whether a number is not NaN."""
    return a == a


@operation(lambda *shapes: shapes[1], lambda condition, a, b: a.symmetric and b.symmetric)
def choose(condition, a, b):
    """`a` if the condition holds, else `b`: numbers or matrices; the condition may differ between entries."""
    return _by_entries(where, condition, a, b)


@operation(lambda shape: ())
def trace(a):
    """The sum of the diagonal."""
    return sum(a[i, i] for i in range(len(a)))


@operation(lambda shape: ())
def count(measured):
    """The number of measured channels."""
    return sum(where(channel, 1.0, 0.0) for channel in measured)


@operation(same)
def exponential(v):
    """e^v of a number, or of each entry of a vector."""
    return np.exp(v)


@operation(lambda a: ())
def logarithm(a):
    """The natural logarithm of a number."""
    return np.log(a)


@operation(same)
def at_most(v, value):
    """The smaller of each entry of a vector and the float `value`."""
    return np.array([where(entry > value, value, entry) for entry in v])


@operation(same)
def at_least(a, value):
    """The larger of a number, or of each entry, and the float `value`; `value` for NaN."""
    return _by_entries(lambda entry: where(entry > value, entry, value), a)


@operation(lambda v, value: v)
def below(v, value):
    """1 for entries of a vector that are not larger than the float `value`, else 0."""
    return np.array([where(entry > value, 0.0, 1.0) for entry in v])


@operation(lambda v: (v[0], v[0]), lambda v: True)
def diagonal(v):
    """The diagonal matrix with the entries of a vector."""
    return np.diag(np.ravel(v))


def constant(value: float, like):
    """A number, or a vector of equal numbers, with the shape and the kind of `like`."""
    return shifted(like * 0.0, float(value)) if isinstance(like, Matrix) else np.full(np.shape(like), value)[()]


reciprocal.derivative(
    lambda result, arguments, slopes: through(lambda slope: slope * result * result * -1.0, slopes[0])
)


@power.derivative
def _of_power(result, arguments, slopes):
    a, exponent = arguments
    return through(lambda slope: slope * power(a, exponent - 1.0) * exponent, slopes[0])


logarithm.derivative(lambda result, arguments, slopes: through(lambda slope: slope / arguments[0], slopes[0]))


@exponential.derivative
def _of_exponential(result, arguments, slopes):
    return through(lambda slope: entries_product(result, slope) if result.shape else result * slope, slopes[0])


@entries_product.derivative
def _of_entries(result, arguments, slopes):
    (a, b), (da, db) = arguments, slopes
    by_a = through(lambda slope: entries_product(slope, b), da)
    return plus(by_a, through(lambda slope: entries_product(a, slope), db))


@at_most.derivative
def _of_limit(result, arguments, slopes):
    v, value = arguments
    return through(lambda slope: entries_product(slope, below(v, value)), slopes[0])


@at_least.derivative
def _of_lower_limit(result, arguments, slopes):
    a, value = arguments
    return through(lambda slope: choose(exceeds(a, value), slope, slope * 0.0), slopes[0])


@magnitude.derivative
def _of_magnitude(result, arguments, slopes):
    return through(lambda slope: choose(exceeds(arguments[0], 0.0), slope, slope * -1.0), slopes[0])


diagonal.derivative(lambda result, arguments, slopes: through(diagonal, slopes[0]))
shifted.derivative(lambda result, arguments, slopes: slopes[0])
trace.derivative(lambda result, arguments, slopes: through(trace, slopes[0]))


@choose.derivative
def _of_choice(result, arguments, slopes):
    condition, *values = arguments
    moves = (a * 0.0 if slope is None else slope for a, slope in zip(values, slopes[1:], strict=True))
    return choose(condition, *moves)


for _jumps in (below, exceeds, is_number, count):
    _jumps.derivative(lambda *_: None)


def slopes_of(wanted: Sequence[Matrix], moves: Mapping[Matrix, Matrix]) -> list[Matrix | None]:
    """Slopes of matrices along one parameter, from those of given matrices, `moves`; None for zero."""
    slopes: dict[Matrix, Matrix | None] = dict(moves)
    for matrix in in_order(wanted):
        if matrix not in slopes:
            of = [slopes[a] if isinstance(a, Matrix) else None for a in matrix.arguments]
            moving = any(slope is not None for slope in of)
            slopes[matrix] = matrix.operation.slope(matrix, matrix.arguments, of) if moving else None
    return [slopes[matrix] for matrix in wanted]
