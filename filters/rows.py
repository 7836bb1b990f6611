"""Where things stand in the float64 rows that compiled code works on.

A model's numbers are one row. A filter's memory is a row of small parts (belief, innovation, scratch), a table
with one column an ensemble member, and a vector of random draws. Rows are cheap to hand to compiled code, to
copy and to stack.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np

from thruster_env.checks import covariance_root
from thruster_env.components import (
    matrix_reader,
    matrix_writer,
    tuple_of,
    vector_reader,
    vector_writer,
    written_out,
)

LANES = 8  # float64 in the widest vector register: ensembles are padded, so that loops have no remainder


def padded(size, lanes):
    """The smallest multiple of `lanes` that is at least `size`."""
    return (size + lanes - 1) // lanes * lanes


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
    return MemoryPlaces(*_starts(n, n * n, 1, 1, 1, 1, m, m * m, 1, n * m))


@cache
def row_access(n: int, m: int) -> tuple[tuple[Callable, Callable], ...]:
    """Functions that read and write a filter's row, as pairs: a vector's, then that of its covariance.

    Vectors are tuples, covariances tuples of rows.

    Returns:
        `read(row)` of the mean (n,) and its covariance (n, n).
        `write(row, value)` of the same.
        `write(row, value)` of the innovation (m,) and its covariance (m, m).
    """
    places = memory_places(n, m)
    return (
        (vector_reader(n, places.mean), matrix_reader(n, n, places.cov)),
        (vector_writer(n, places.mean), matrix_writer(n, n, places.cov)),
        (vector_writer(m, places.innovation), matrix_writer(m, m, places.innovation_cov)),
    )


class NumberPlaces(NamedTuple):
    """First places of the parts of a model's row, for n states and m measurements."""

    q: int  # (n, n), process noise covariance
    q_root: int  # (n, n), lower triangular, q_root q_root' = q
    r: int  # (m, m), measurement noise covariance
    r_root: int  # (m, m)
    prior_mean: int  # (n,)
    prior_cov: int  # (n, n)
    prior_root: int  # (n, n)
    scales: int  # (n,), what small steps of each state are measured in
    substeps: int
    constants: int  # the model's own constants; a filter's own numbers follow


@cache
def number_places(n: int, m: int) -> NumberPlaces:
    """Places in the row of a model's numbers; see `StateSpaceModel.numbers`."""
    return NumberPlaces(*_starts(n * n, n * n, m * m, m * m, n, n * n, n * n, n, 1))


def with_root(cov: np.ndarray) -> np.ndarray:
    """A covariance (d, d) and its lower triangular root, as they lie one behind the other in a model's row."""
    return np.concatenate([cov.ravel(), covariance_root(cov).ravel()])


def own_place(n: int, m: int, form: type | int) -> int:
    """First place of a filter's own numbers, behind those of its model; form is that of `constants_form`."""
    return number_places(n, m).constants + (form if isinstance(form, int) else len(form._fields))


def _starts(*lengths: int) -> list[int]:
    return [0, *np.cumsum(lengths).tolist()]


def constants_form(constants: tuple) -> type | int:
    """What `constants_reader` needs to know of a model's constants: their NamedTuple class, or how many."""
    return type(constants) if hasattr(constants, "_fields") else len(constants)


@cache
def constants_reader(n: int, m: int, form: type | int) -> Callable:
    """Return `read(numbers)`: the model's constants as its functions take them."""
    start = number_places(n, m).constants
    count = form if isinstance(form, int) else len(form._fields)
    values = [f"row[{start + i}]" for i in range(count)]
    if isinstance(form, int):
        return written_out("read", "row", tuple_of(values))
    return written_out("read", "row", f"Constants({', '.join(values)})", Constants=form)
