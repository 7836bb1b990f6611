"""Systematic resampling of columns of a table, by weights in one of its rows."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

from thruster_env.core.compiled import inlined

SCRATCH_ROWS = 3


@cache
def systematic_resampler(rows: int, weights: int, scratch: int) -> Callable:
    """Return `resample(table, size, u)`: rows 0 ... rows - 1 of N columns drawn by weight, for u in (0, 1).

    New column j is the old column i in whose weight (u + j)/N of the sum of weights lies: i is drawn N w_i times
    rounded up or down, and N w_i times on average. `SCRATCH_ROWS` rows from `scratch` on are written over; what
    pads the table becomes a copy of the first column.

    Source: Kitagawa (1996), "Monte Carlo filter and smoother for non-Gaussian nonlinear state space models",
    J. Computational and Graphical Statistics 5(1), appendix.
    """
    sums, parents, new = range(scratch, scratch + SCRATCH_ROWS)

    @inlined
    def resample(table, size, u):
        total = 0.0
        for i in range(size):
            total += table[weights, i]
            table[sums, i] = total
            table[parents, i] = 0.0
        if not total > 0.0:
            return
        # Where old column i starts among the new ones. One that is not drawn starts where the next one does,
        # which writes over it: without a branch on chance this takes a third of the time.
        parts = size / total
        for i in range(1, size):
            first = int(table[sums, i - 1] * parts - u + 1.0)
            if first < size:
                table[parents, first] = i
        parent = 0.0
        for j in range(size):
            parent = table[parents, j] if table[parents, j] > parent else parent
            table[parents, j] = parent
        for i in range(rows):
            for j in range(size):
                table[new, j] = table[i, int(table[parents, j])]
            for j in range(size):
                table[i, j] = table[new, j]
            for j in range(size, table.shape[1]):
                table[i, j] = table[new, 0]

    return resample
