"""Angles: numbers of which those a turn apart are the same, and so differences go the short way round.

A belief's mean of an angle lies in (-pi, pi]. A sample of one, whether an ensemble, weighted particles or the
parts of a mixture, is first put on one branch: each member is moved by whole turns to within half a turn of the
sample's circular mean. From then on means, distances from them and covariances are those of plain numbers. So
distances from the mean sum up to zero, as the algebra of ensembles has it, which those from the circular mean
itself would not; and a sample far from the cut at pi has the moments that it has without all this.

Nothing here leaves a trace in the code of a model without angles.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cache

import numpy as np

from numerics.compiled import inlined
from numerics.tuples import tuple_of, written_out

TURN = 2.0 * math.pi


@inlined
def whole_turns(x):
    """What an angle x [rad] has beyond (-pi, pi], a multiple of a turn; of a number or an array."""
    return TURN * np.ceil((x - math.pi) / TURN)


@inlined
def wrapped(x):
    """The angle x [rad] in (-pi, pi], of a number or an array."""
    return x - whole_turns(x)


NAMES = {  # of sources about angles
    "wrapped": wrapped,
    "whole_turns": whole_turns,
    "sin": np.sin,
    "cos": np.cos,
    "arctan2": np.arctan2,
}


def is_angle(index: int, angles: Sequence[bool]) -> bool:
    """Whether component `index` is an angle; no component is where there are no flags."""
    return index < len(angles) and angles[index]


def short_way(expression: str, index: int, angles: Sequence[bool]) -> str:
    """Source of a difference in component `index`, wrapped where that is an angle; for functions with `NAMES`."""
    return f"wrapped({expression})" if is_angle(index, angles) else expression


def wrapped_where(x: np.ndarray, angles: Sequence[bool]) -> np.ndarray:
    """Vectors x (..., d), their angles in (-pi, pi]; x itself where there are none."""
    return np.where(angles, wrapped(x), x) if any(angles) else x


def difference(a: np.ndarray, b: np.ndarray, angles: Sequence[bool]) -> np.ndarray:
    """Errors a - b of vectors (..., d), the short way round in components that are angles (d,)."""
    return wrapped_where(np.subtract(a, b), angles)


@cache
def kept(function: Callable, arguments: str, angles: tuple[bool, ...]) -> Callable:
    """A function of the arguments that returns a vector, with its angles in (-pi, pi]."""
    if not any(angles):
        return function
    entries = (short_way(f"found[{i}]", i, angles) for i in range(len(angles)))
    call = f"found = function({arguments})"
    return written_out("kept", arguments, call, tuple_of(entries), function=inlined(function), **NAMES)


@cache
def angle_writer(start: int, angles: tuple[bool, ...]) -> Callable:
    """Return `store(row, x)`: write a tuple into row[start], row[start + 1], ..., its angles in (-pi, pi]."""
    lines = (f"row[{start + i}] = {short_way(f'x[{i}]', i, angles)}" for i in range(len(angles)))
    return written_out("store", "row, x", *lines, "None", **NAMES)


def circular_mean(values: Sequence[str]) -> str:
    """Source of the direction [rad] of the sum of unit vectors in the directions `values`."""
    sums = (" + ".join(f"{name}({value})" for value in values) for name in ("sin", "cos"))
    return f"arctan2({', '.join(sums)})"


@cache
def row_aligner(first: int, angles: tuple[bool, ...], weights: int | None = None) -> Callable:
    """Return `align(table, size)`: put rows first + i that are angles on the branch of their first `size` entries.

    Args:
        first: the first of the rows.
        angles: which of them are angles.
        weights: row of the entries' weights; if None, all are alike.
    """
    factor = "" if weights is None else f"table[{weights}, j] * "
    lines = []
    for row in (first + i for i, angle in enumerate(angles) if angle):
        lines += [
            "s = c = 0.0",
            "for j in range(size):",
            f"    s += {factor}sin(table[{row}, j])",
            f"    c += {factor}cos(table[{row}, j])",
            "middle = arctan2(s, c)",
            "for j in range(table.shape[1]):",
            f"    table[{row}, j] -= whole_turns(table[{row}, j] - middle)",
        ]
    return written_out("align", "table, size", *lines, "None", **NAMES)
