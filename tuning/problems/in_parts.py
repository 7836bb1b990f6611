"""Estimates of many runs, some runs at a time: covariances of every step of a large model fill memories."""

from __future__ import annotations

from collections.abc import Iterator

from filters.engine.batch import Estimates, run
from filters.filter import Filter
from numerics.progress import told
from numerics.threads import cores
from plants.layout import LANES
from tuning.problems.data import Data

MOST_BYTES = 2**28  # of estimates at once: those of a run of 1000 steps with forty states and channels take 26 MB


def estimates_in_parts(filter_: Filter, data: Data) -> Iterator[tuple[Data, Estimates]]:
    """Run a filter on some runs after the others, in order: their data, and the estimates on them.

    Estimates at a time take some 256 MB, or those of as many runs as there are cores, so that what is made of them
    need not hold the covariances of all.
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
    size = size // LANES * LANES or size  # of those without an ensemble so many are filtered side by side
    return [(first, min(first + size, count)) for first in range(0, count, size)]
