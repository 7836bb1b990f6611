"""Angles: values that differ by whole turns are equal, so differences between angles are wrapped.

The mean of an angle in a belief lies in (-pi, pi]. A sample of an angle (an ensemble, weighted particles or the
parts of a mixture) is first moved to one branch: whole turns are added to each member until it lies within half a
turn of the sample's circular mean. Means, deviations and covariances are then computed as for ordinary numbers.
Deviations from this mean sum up to zero, which the algebra of ensembles needs; deviations from the circular mean
itself would not. A sample far from the cut at pi keeps its ordinary moments.

The compiled code of a model without angles does not change.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cache, lru_cache
from typing import Any

import numpy as np

from thruster_env.core.sources import Index, Source, written_out

TURN = 2.0 * math.pi


def whole_turns(x):
    """Whole turns [rad] to subtract from an angle x [rad], a number or an array, so that it lies in (-pi, pi]."""
    return TURN * np.ceil((x - math.pi) / TURN)


def wrapped(x):
    """The angle x [rad] in (-pi, pi], of a number or an array."""
    return x - whole_turns(x)


NAMES: dict[str, Any] = {  # of sources about angles
    "wrapped": wrapped,
    "whole_turns": whole_turns,
    "sin": np.sin,
    "cos": np.cos,
    "arctan2": np.arctan2,
}


def is_angle(index: int, angles: Sequence[bool]) -> bool:
    """Whether component `index` is an angle; without flags no component is."""
    return index < len(angles) and angles[index]


def angle_indices(angles: Sequence[bool], first: int = 0) -> tuple[int, ...]:
    """Indices of the components that are angles, counted from `first`."""
    return tuple(first + i for i, angle in enumerate(angles) if angle)


def at_angle(index: int | Index, angles: Sequence[bool], if_angle: str, elsewhere: str) -> str:
    """Source `if_angle` for components that are angles, else `elsewhere`; loops decide at run time."""
    if not isinstance(index, Index):
        return if_angle if is_angle(index, angles) else elsewhere
    if all(angles):
        return if_angle if angles else elsewhere
    return f"({if_angle} if {index} in {angle_indices(angles)} else {elsewhere})" if any(angles) else elsewhere


def short_way(expression: str, index: int | Index, angles: Sequence[bool]) -> str:
    """Source of a difference in component `index`, wrapped if that is an angle; for functions with `NAMES`."""
    return at_angle(index, angles, f"wrapped({expression})", expression)


def wrapped_where(x: np.ndarray, angles: Sequence[bool]) -> np.ndarray:
    """Vectors x (..., d) with their angles in (-pi, pi]; x itself if none is an angle."""
    return np.where(angles, wrapped(x), x) if any(angles) else x


def difference(a: np.ndarray, b: np.ndarray, angles: Sequence[bool]) -> np.ndarray:
    """Differences a - b of vectors (..., d), wrapped to (-pi, pi] in components that are angles (d,)."""
    return wrapped_where(np.subtract(a, b), angles)


def on_one_branch(rows: np.ndarray, angles: Sequence[bool]) -> np.ndarray:
    """Samples (N, d), each angle within half a turn of the circular mean of its column; NaN counts for nothing.

    Their standard deviation or range can then be computed as that of ordinary numbers.
    """
    if not any(angles):
        return rows
    rows = wrapped_where(rows, angles)
    for i in np.flatnonzero(angles):
        middle = np.arctan2(np.nansum(np.sin(rows[:, i])), np.nansum(np.cos(rows[:, i])))
        rows[:, i] -= whole_turns(rows[:, i] - middle)
    return rows


def with_breaks(x: np.ndarray, *lines: np.ndarray) -> tuple[np.ndarray, ...]:
    """Points x (N,) and lines over them (N,), NaN put in where the first line jumps by more than half a turn."""
    jumps = np.flatnonzero(abs(np.diff(lines[0])) > math.pi) + 1
    return np.insert(x, jumps, x[jumps]), *(np.insert(line, jumps, np.nan) for line in lines)


@lru_cache(maxsize=64)
def with_wrapped_angles(function: Callable, arguments: str, angles: tuple[bool, ...]) -> Callable:
    """Wrap the angles in the vector that a function of the arguments returns to (-pi, pi]."""
    if not any(angles):
        return function
    source = Source("kept", arguments, result=(len(angles),))
    source.line(f"found = function({arguments})")
    entries = source.vector(len(angles), lambda i: short_way(f"found[{i}]", i, angles))
    return source.function(entries, function=function, **NAMES)


@cache
def angle_writer(start: int, angles: tuple[bool, ...]) -> Callable:
    """Return `store(row, x)`: write a vector into row[start], row[start + 1], ..., its angles in (-pi, pi]."""
    source = Source("store", "row, x", x=(len(angles),))
    for i in source.range(len(angles)):
        source.line(f"row[{start + i}] = {short_way(f'x[{i}]', i, angles)}")
    return source.function(**NAMES)


@cache
def row_brancher(count: int, angles: tuple[bool, ...]) -> Callable:
    """Return `align(y)`: rows y (count, d), each angle on the branch of its circular mean; some must be angles."""
    size = len(angles)
    source = Source("align", "y", result=(count, size), y=(count, size))
    middle = source.local("middle", size)
    for a in source.among(angle_indices(angles)):
        sums = [source.sum(f"{name}(y[{i}][{a}])" for i in source.range(count)) for name in ("sin", "cos")]
        source.line(f"{middle[a]} = arctan2({', '.join(sums)})")

    def entry(i, a):
        value = f"y[{i}][{a}]"
        return at_angle(a, angles, f"{middle[a]} + wrapped({value} - {middle[a]})", value)

    return source.function(source.matrix(count, size, entry), **NAMES)


@cache
def row_aligner(first: int, angles: tuple[bool, ...], weights: int | None = None) -> Callable:
    """Return `align(table, size)`: put rows first + i that are angles on the branch of their first `size` entries.

    Args:
        first: the first of the rows.
        angles: which of them are angles.
        weights: row of the entries' weights; if None, all are alike.
    """
    factor = "" if weights is None else f"table[{weights}, j] * "
    lines = (
        f"for i in {angle_indices(angles, first)}:",
        "    s = c = 0.0",
        "    for j in range(size):",
        f"        s += {factor}sin(table[i, j])",
        f"        c += {factor}cos(table[i, j])",
        "    middle = arctan2(s, c)",
        "    for j in range(table.shape[1]):",
        "        table[i, j] -= whole_turns(table[i, j] - middle)",
    )
    return written_out("align", "table, size", *lines, "None", **NAMES)
