"""Places of a model's numbers in the float64 row that compiled code reads."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, lru_cache
from typing import NamedTuple

import numpy as np

from thruster_env.core.checks import covariance_root
from thruster_env.core.tuples import tuple_of, written_out
from thruster_env.model.shape import Shape, constants_are_array

LANES = 8  # float64 in the widest vector register: ensembles are padded, so that loops have no remainder


def padded(size, lanes):
    """The smallest multiple of `lanes` that is at least `size`."""
    return (size + lanes - 1) // lanes * lanes


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
    return NumberPlaces(*starts_of(n * n, n * n, m * m, m * m, n, n * n, n * n, n, 1))


def with_root(cov: np.ndarray) -> np.ndarray:
    """A covariance (d, d) followed by its lower triangular root, as in a model's row."""
    return np.concatenate([cov.ravel(), covariance_root(cov).ravel()])


def starts_of(*lengths: int) -> list[int]:
    """First places of consecutive parts, and the end of the last one."""
    return [0, *np.cumsum(lengths).tolist()]


@lru_cache(maxsize=64)
def constants_reader(shape: Shape) -> Callable:
    """Return `read(numbers)`: the model's constants as its functions take them."""
    start = number_places(shape.n, shape.m).constants
    if constants_are_array(shape.form):
        return written_out("read", "row", f"row[{start}:{start + shape.constants}]")
    values = [f"row[{start + i}]" for i in range(shape.constants)]
    if isinstance(shape.form, int):
        return written_out("read", "row", tuple_of(values))
    return written_out("read", "row", f"Constants({', '.join(values)})", Constants=shape.form)
