"""Layout of the memory of a filter.

A filter's memory is a row of small parts (belief, innovation, scratch), a table with one column per ensemble
member, and a vector of random draws. Rows are cheap to hand to compiled code, to copy and to stack. The row of a
model's numbers, behind which a filter has its own, is laid out by `thruster_env.model.layout`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, lru_cache
from typing import NamedTuple

from thruster_env.core.angles import angle_writer
from thruster_env.core.tuples import matrix_reader, matrix_writer, vector_reader, vector_writer
from thruster_env.model.layout import number_places, starts_of
from thruster_env.model.shape import Shape


class MemoryPlaces(NamedTuple):
    """First places of the parts of a filter's row, for n states and m measurements."""

    mean: int  # (n,)
    cov: int  # (n, n)
    key_0: int
    key_1: int
    step: int  # steps taken
    divergences: int  # restarts after an estimate that was not finite
    innovation: int  # (m,)
    innovation_cov: int  # (m, m)
    log_likelihood: int
    gain: int  # (n, m), scratch
    extras: int  # what a kind of filter keeps beside; the row ends with these


@cache
def memory_places(n: int, m: int) -> MemoryPlaces:
    """Places in the row of a filter."""
    return MemoryPlaces(*starts_of(n, n * n, 1, 1, 1, 1, m, m * m, 1, n * m))


def mean_writer(shape: Shape) -> Callable:
    """Return `store(row, x)`: write the mean, its angles in (-pi, pi]."""
    return angle_writer(memory_places(shape.n, shape.m).mean, shape.state_angles)


@lru_cache(maxsize=64)
def row_access(shape: Shape) -> tuple[tuple[Callable, Callable], ...]:
    """Functions that read and write a filter's row, as pairs: a vector's, then that of its covariance.

    Vectors are tuples, covariances tuples of rows. Angles in a mean are kept in (-pi, pi].

    Returns:
        `read(row)` of the mean (n,) and its covariance (n, n).
        `write(row, value)` of the same.
        `write(row, value)` of the innovation (m,) and its covariance (m, m).
    """
    n, m = shape.n, shape.m
    places = memory_places(n, m)
    return (
        (vector_reader(n, places.mean), matrix_reader(n, n, places.cov)),
        (mean_writer(shape), matrix_writer(n, n, places.cov)),
        (vector_writer(m, places.innovation), matrix_writer(m, m, places.innovation_cov)),
    )


def own_place(shape: Shape) -> int:
    """Offset of the filter's own parameters in the packed row, behind those of its model."""
    return number_places(shape.n, shape.m).constants + shape.constants
