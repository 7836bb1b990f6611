"""Estimates of many runs, in parts: the covariances of all steps of a large model need much memory."""

from __future__ import annotations

from collections.abc import Iterator

from filters.engine.batch import Estimates, run
from filters.filter import Filter
from numerics.progress import told
from numerics.threads import cores
from plants.layout import LANES
from tuning.problems.data import Data

MOST_BYTES = 2**28  # of a part's estimates: a run of 1000 steps with forty states and channels takes 26 MB


def estimates_in_parts(filter_: Filter, data: Data) -> Iterator[tuple[Data, Estimates]]:
    """Run a filter on parts of the runs, in order; yield the data of each part and the estimates on them.

    The estimates of a part take at most about 256 MB, or are those of as many runs as there are cores.
    """
    parts = parts_of(filter_, data)
    for first, last in told("runs", parts, [last - first for first, last in parts]):
        some = data.slice(first, last)
        yield some, run(filter_, some.filter_keys, some.inputs, some.measurements)


def parts_of(filter_: Filter, data: Data) -> list[tuple[int, int]]:
    """First run, and the one after the last, of each part that `estimates_in_parts` makes of some data."""
    n, (count, times, m) = filter_.kernel_model.n, data.measurements.shape
    a_run = 8 * times * (n + n * n + m + m * m + 1)
    size = max(MOST_BYTES // a_run, cores())
    size = size // LANES * LANES or size  # filters without an ensemble run so many side by side
    return [(first, min(first + size, count)) for first in range(0, count, size)]
