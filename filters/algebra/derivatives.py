"""Derivatives of matrices along one parameter: beside each stands its slope, by the rules of their operations.

The slopes are Matrices of the same graph. So what they share with the values, and with one another, is there
once: a gain, a quotient S^-1 v, the product P H'. A slope of None is zero, and what would be made of it is left
out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from filters.algebra.matrices import Matrix, in_order


def slopes_of(wanted: Sequence[Matrix], moves: Mapping[Matrix, Matrix]) -> list[Matrix | None]:
    """Slopes of matrices in the direction in which those that are given move; None of what does not move."""
    slopes: dict[Matrix, Matrix | None] = dict(moves)
    for one in in_order(wanted):
        if one not in slopes:
            of = [slopes[a] if isinstance(a, Matrix) else None for a in one.arguments]
            moving = any(slope is not None for slope in of)
            slopes[one] = one.operation.slope(one, one.arguments, of) if moving else None
    return [slopes[one] for one in wanted]
