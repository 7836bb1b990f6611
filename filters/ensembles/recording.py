"""The members of an ensemble filter after every step, which `filters.run` does not keep."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from filters.engine.session import Session
from filters.ensembles.ensemble import EnsembleFilter
from filters.filter import Filter
from thruster_env.core.checks import at_least


class Members(NamedTuple):
    """Ensembles of B runs after some of the measurements."""

    members: np.ndarray  # (B, T, n, N)
    weights: np.ndarray | None  # (B, T, N) with sum 1; None where all members weigh the same
    steps: np.ndarray  # (T,), indices of these measurements


def record_members(
    filter_: Filter,
    keys: np.ndarray,
    inputs: np.ndarray,
    measurements: np.ndarray,
    *,
    first: int = 0,
    every: int = 1,
) -> Members:
    """Run an ensemble filter over trajectories and keep its members.

    They are those of `filters.run` with the same arguments. All ensembles of a long batch fill much memory,
    8 B T n N bytes. For a rank histogram some tens of runs are enough, and so is a part of their steps.

    Args:
        filter_: a filter with an ensemble.
        keys: (B, 2).
        inputs: (B, K, p).
        measurements: (B, K + 1, m), NaN where missing.
        first: index of the first measurement after which members are kept, ...
        every: ... and how many measurements later they are kept again.

    Raises:
        ValueError: if the filter has no ensemble, or a number is wrong.
    """
    if filter_.size == 0:
        raise ValueError(f"members need a filter with an ensemble, but got {filter_.name!r}")
    session, n = Session(filter_), filter_.kernel_model.n
    count, times = measurements.shape[:2]
    steps = np.arange(at_least("first", first, 0), times, at_least("every", every, 1))
    rows = n if isinstance(filter_, EnsembleFilter) else n + 1  # particles have weights
    kept = np.empty((count, len(steps), rows, filter_.size))
    for b in range(count):
        session.start(keys[b], measurements[b, 0])
        for k in range(times):
            if k > 0:
                session.step(inputs[b, k - 1], measurements[b, k])
            place, off = divmod(k - first, every)
            if place >= 0 and off == 0:
                kept[b, place] = filter_.sample(session.belief())
    if rows == n:
        return Members(kept, None, steps)
    weights = np.exp(kept[:, :, n] - kept[:, :, n].max(axis=-1, keepdims=True))  # row n holds their logarithms
    return Members(kept[:, :, :n], weights / weights.sum(axis=-1, keepdims=True), steps)
