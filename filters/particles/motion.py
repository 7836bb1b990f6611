"""What members expect to be measured in channels that are missing."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

from thruster_env.numerics.angles import row_aligner
from thruster_env.numerics.compiled import inlined


@cache
def silencer(first: int, angles: tuple[bool, ...], weights: int | None = None) -> Callable:
    """Return `silence(table, z, size)`, for rows first, first + 1, ... of what the members expect to be measured.

    They become 0 where z is NaN: a constant has no covariance with anything. Angles are put on one branch.
    """

    @inlined
    def silence(table, z, size):
        for i in range(z.shape[0]):
            if z[i] != z[i]:
                for j in range(table.shape[1]):
                    table[first + i, j] = 0.0

    if not any(angles):
        return silence
    align = row_aligner(first, angles, weights)

    @inlined
    def silence_and_align(table, z, size):
        silence(table, z, size)
        align(table, size)

    return silence_and_align
