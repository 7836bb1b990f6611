"""Estimates of many runs, in parts: the covariances of all steps of a large model need much memory."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from filters.engine.batch import Estimates, run
from filters.estimators.foreign import ForeignFilter
from filters.filter import Filter
from thruster_env.core.progress import with_progress
from thruster_env.core.threads import cores
from thruster_env.model.shape import LANES
from tuning.problems.data import Data, padded

MOST_BYTES = 2**28  # of a part's estimates: a run of 1000 steps with forty states and channels takes 26 MB


def estimates_in_parts(filter_: Filter, data: Data) -> Iterator[tuple[Data, Estimates]]:
    """Run a filter on parts of the runs, in order; yield the data of each part and the estimates on them.

    The estimates of a part take at most about 256 MB, or are those of as many runs as there are cores.
    """
    parts = parts_of(filter_, data)
    for first, last in with_progress("runs", parts, [last - first for first, last in parts]):
        some = data.slice(first, last)
        yield some, estimates_on(filter_, some)


def estimates_on(filter_: Filter, data: Data) -> Estimates:
    """Run a filter over all runs of some data; results and restarts in a run's padding are not counted.

    An estimator of another package runs as far as each run goes, for it may have no estimate beyond.
    """
    seen = data.seen
    if data.counted is not None and isinstance(filter_, ForeignFilter):
        return _one_by_one(filter_, data)
    found = run(filter_, seen.filter_keys, seen.inputs, seen.measurements)
    if data.counted is None:
        return found
    divergences = found.divergences.copy()
    for place in np.flatnonzero((divergences > 0) & (data.rows <= data.steps)).tolist():
        divergences[place] = _alone(filter_, data, place).divergences[0]
    return found._replace(divergences=divergences)


def _one_by_one(filter_: Filter, data: Data) -> Estimates:
    """Estimates of runs of different lengths, NaN in their padding."""
    found = [_alone(filter_, data, place) for place in range(len(data.seeds))]
    *fields, restarts = Estimates._fields
    parts = {name: padded([getattr(one, name)[0] for one in found], data.steps + 1) for name in fields}
    return Estimates(**parts, **{restarts: np.concatenate([one.divergences for one in found])})


def _alone(filter_: Filter, data: Data, place: int) -> Estimates:
    one = data.one(place)
    return run(filter_, one.filter_keys, one.inputs, one.measurements)


def parts_of(filter_: Filter, data: Data) -> list[tuple[int, int]]:
    """First run, and the one after the last, of each part that `estimates_in_parts` makes of some data."""
    n, (count, times, m) = filter_.kernel_model.n, data.measurements.shape
    a_run = 8 * times * (n + n * n + m + m * m + 1)
    size = max(MOST_BYTES // a_run, cores())
    size = size // LANES * LANES or size  # filters without an ensemble run so many side by side
    return [(first, min(first + size, count)) for first in range(0, count, size)]
