"""The contract of a filter: `init`, `predict(belief, u)`, `update(belief, z)`, all pure.

A filter is a frozen value that holds a model and its own tunable numbers. Each kind supplies three plain
functions that work in place on one row of floats and one table of members (`Kernels`); everything else,
single steps and whole batches, compiled or not, is made from these in `filters.engine`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np

from filters.model import StateSpaceModel


class Belief(NamedTuple):
    """What a filter believes of the state at one time."""

    mean: np.ndarray  # (n,)
    cov: np.ndarray  # (n, n)
    members: np.ndarray  # (n, N) ensemble, one row a state component; N = 0 for Gaussian filters
    key: tuple[int, int]  # what all its randomness depends on, together with ...
    step: int  # ... the number of steps predicted so far
    divergences: int  # restarts from the prior after an estimate that was not finite


class Innovation(NamedTuple):
    """What a measurement said beyond the prediction."""

    value: np.ndarray  # (m,), z - E[z]; zero in missing channels
    cov: np.ndarray  # (m, m), S
    log_likelihood: float  # log N(value; 0, S) of the channels that were there


class Kernels(NamedTuple):
    """A kind of filter for one shape of model, as plain functions on its memory.

    `row` and `numbers` are laid out by `filters.rows`; `table` is (table_rows, padded size), its first n rows the
    members, without columns for filters without an ensemble; `draws` has room for `draws_per_member` normals a
    member.
    """

    n: int
    m: int
    table_rows: int
    draws_per_member: int
    start: Callable  # start(memory, numbers, size): belief = prior; memory = (row, table, draws)
    predict: Callable  # predict(memory, u, numbers, size)
    update: Callable  # update(memory, z, numbers, size); a NaN in z is a missing channel


@dataclass(frozen=True, kw_only=True, eq=False)
class Filter:
    """Base of all filters; subclasses add their tunable numbers and the method `kernels`.

    Attributes:
        model: the `StateSpaceModel` that the filter assumes.
    """

    name: ClassVar[str]
    model: StateSpaceModel

    def kernels(self) -> Kernels:
        """The functions of this kind of filter for the shape of its model."""
        raise TypeError(f"{type(self).__name__} has no kernels: use one of its subclasses")

    @property
    def kernel_model(self) -> StateSpaceModel:
        """The model whose functions and numbers the kernels use: the given one, unless a filter replaces it."""
        return self.model

    @property
    def size(self) -> int:
        """Number of ensemble members; 0 for filters without an ensemble."""
        return 0

    def init(self, key: tuple[int, int] = (0, 0)) -> Belief:
        """The prior as a belief; key is two integers below 2^32."""
        session = self._session()
        session.set_key(key)
        session.run("start")
        return session.belief()

    def predict(self, belief: Belief, u) -> Belief:
        """The belief one step later under input u (p,)."""
        session = self._session()
        session.load(belief)
        session.run("predict", u=u)
        return session.belief()

    def update(self, belief: Belief, z) -> tuple[Belief, Innovation]:
        """The belief after measurement z (m,), and the innovation; a NaN in z leaves that channel out."""
        session = self._session()
        session.load(belief)
        session.run("update", z=z)
        return session.belief(), session.innovation_copy()

    def _session(self):
        from filters.engine import Session

        return Session(self)
