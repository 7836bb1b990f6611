"""Beliefs, innovations, and the plain functions that a kind of filter is made of."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np


class Belief(NamedTuple):
    """The estimate of a filter at one time.

    Attributes:
        mean: of the state, (n,), in the units of the model.
        cov: covariance of the error, (n, n).
        members: of an ensemble, (n, N), one row for each state; N = 0 for Gaussian filters. Particle filters add a
            row of log weights.
        key: two integers on which all random draws depend, together with `step`.
        step: number of steps predicted so far.
        divergences: restarts from the prior after an estimate that was not finite.
        extras: what else the filter keeps, such as an estimate of R.
    """

    mean: np.ndarray
    cov: np.ndarray
    members: np.ndarray
    key: tuple[int, int]
    step: int
    divergences: int
    extras: np.ndarray = np.empty(0)


class LostBelief(Belief):
    """What `predict` returns where a belief is no longer finite; the next update restarts from the prior."""

    __slots__ = ()


class Innovation(NamedTuple):
    """Innovation of an update: measurement minus its prediction.

    Attributes:
        value: z - E[z], (m,), in the units of the measurements; zero in missing channels.
        cov: its covariance S, (m, m).
        log_likelihood: log N(value; 0, S) of the channels that were measured.
    """

    value: np.ndarray
    cov: np.ndarray
    log_likelihood: float


class Kernels(NamedTuple):
    """A kind of filter for one shape of model, as plain functions on its memory.

    `row` is laid out by `filters.engine.layout`, `numbers` by `thruster_env.model.layout`; `table` is
    (table_rows, padded size), its first n rows the members, without columns for filters without an ensemble;
    `draws` has room for `draws_per_member` normals a member. Besides mean and covariance a belief keeps the first
    `kept_rows` rows of the table and `extras` values of the row, from `memory_places(n, m).extras` on; `scratch`
    values that are not kept follow.

    `vectors`, where given, are what `predict` does before its substeps, in each of them and after them, and
    `update`, each for eight beliefs that lie together, as functions (rows, given, numbers): batches then run them
    (`engine.side_by_side`).
    """

    n: int
    m: int
    table_rows: int
    draws_per_member: int
    start: Callable  # start(memory, numbers, size): belief = prior; memory = (row, table, draws)
    predict: Callable  # predict(memory, u, numbers, size)
    update: Callable  # update(memory, z, numbers, size); a NaN in z is a missing channel
    summarise: Callable  # summarise(memory, size): mean and cov from the members; `update` does it itself
    extras: int = 0
    extra_kept_rows: int = 0  # rows of the table, after the n of members, that belong to the belief
    scratch: int = 0
    vectors: tuple[Callable, ...] = ()

    @property
    def kept_rows(self) -> int:
        """Rows of the table that belong to the belief."""
        return self.n + self.extra_kept_rows
