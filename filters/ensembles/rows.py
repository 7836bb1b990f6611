"""Rows of the table of an ensemble, a state's or a channel's numbers of all members: moments, and their spread."""

from __future__ import annotations

from thruster_env.core.compiled import inlined


@inlined
def row_moments(table, i, size):
    """Mean and sample variance of a row of the members."""
    mean, squares = 0.0, 0.0
    for j in range(size):
        mean += table[i, j] / size
    for j in range(size):
        squares += (table[i, j] - mean) ** 2
    return mean, squares / (size - 1)


@inlined
def stretch_row(table, i, factor, size):
    """A row's distances from its mean, times a factor."""
    mean = 0.0
    for j in range(size):
        mean += table[i, j] / size
    for j in range(table.shape[1]):
        table[i, j] = mean + factor * (table[i, j] - mean)


@inlined
def relax_row(table, i, before, part, size):
    """Give back a part of what the standard deviation of a row has lost, of its variance before an update."""
    _, after = row_moments(table, i, size)
    if after > 0.0:
        stretch_row(table, i, 1.0 + part * ((before / after) ** 0.5 - 1.0), size)
