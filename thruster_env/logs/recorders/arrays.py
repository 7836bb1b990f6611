"""Arrays by name, as MATLAB and HDF5 keep them: which are channels, and which vector has their times."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from thruster_env.logs.columns import TIME_NAMES
from thruster_env.logs.recorders.topics import MOST_COLUMNS, Refused, Topic, Wanted, check_bytes, columns_of
from thruster_env.logs.stamps import in_seconds
from thruster_env.logs.units import parted

NUMERIC = "biuf"  # NumPy's kinds
FEWEST = 2  # samples; what has fewer is a constant


def topics_of(
    found: Mapping[str, Any],
    path: Path,
    wanted: Wanted = None,
    unit: Callable[[Any], Sequence[str]] = lambda one: (),
) -> Iterator[Topic]:
    """The channels among arrays: a vector, or a matrix whose columns are channels NAME[0], NAME[1] and so on.

    Times are the vector `time` (or t, time_ms and the like) beside an array, or else in a group around it, if it
    is as long as the array; of a matrix, times may run along either side.

    Args:
        found: arrays by "GROUP.NAME", with shape, dtype and what `[...]` reads; or a text, why one is refused.
        path: of the file, for messages.
        wanted: columns that are read; None for all.
        unit: of an array, or one for each of its columns; empty where it has none.

    Raises:
        ValueError: if an array is wanted that is refused, or too large.
    """
    sizes = {name: _size(one) for name, one in found.items()}
    vectors: dict[str, dict[str, int]] = {}  # of times, their lengths by group and name
    for name, size in sizes.items():
        if size is not None and size[1] == 1 and _is_time(name):
            vectors.setdefault(name.rpartition(".")[0], {})[name] = size[0]
    known: dict[str, tuple[np.ndarray | None, str]] = {}
    if wanted is None:
        within = {name[:place] for name in found for place, letter in enumerate(name) if letter in "({"}
        refused = {name: why for name, one in found.items() if (why := _why_not(one)) and name not in within}
        yield from [Topic("", None, {}, unread=refused)] if refused else []
    for name, one in found.items():
        if wanted is not None and not any(each == name or each.startswith(f"{name}[") for each in wanted):
            continue
        if why := _why_not(one):
            if wanted is not None:
                raise Refused(f"a field must be an array of numbers, but {name!r} is {why} ({path})")
            continue
        if sizes[name] is None:
            continue
        clock, along = next(
            (each for each in _clocks(name, vectors) if each[1] in one.shape), (None, max(one.shape))
        )
        if math.prod(one.shape) > MOST_COLUMNS * along:
            continue
        group, _, field = name.rpartition(".")
        try:
            values = _read(name, one, path)
            if clock is not None and clock not in known:
                known = {clock: _times(clock, found[clock], path, unit)}
        except Refused:
            raise
        except Exception as error:  # of this one alone
            why = " ".join(str(error).split())[:160] or type(error).__name__
            if wanted is not None:
                raise Refused(
                    f"a field must be one that can be read, but {name!r} is not: {why} ({path})"
                ) from None
            yield Topic("", None, {}, unread={name: f"damaged: {why}"})
            continue
        values = values if values.shape[0] == along else values.T
        fields = columns_of(field, values)
        own, taken = known[clock] if clock is not None else (None, "")
        yield Topic(group, own, fields, _units(unit(one), [*fields]), taken=taken)


def _units(texts: Sequence[str], fields: Sequence[str]) -> dict[str, str]:
    """The units of fields: one for all or one for each; of any other number all texts, which are no unit."""
    each = texts if len(texts) == len(fields) else [", ".join(texts)] * len(fields)
    return {field: text for field, text in zip(fields, each, strict=True) if text}


def _times(
    clock: str, one: Any, path: Path, unit: Callable[[Any], Sequence[str]]
) -> tuple[np.ndarray | None, str]:
    """The times in a vector [s], None for those of an unknown unit; and how they were read, in words."""
    try:
        times = _read(clock, one, path).astype(np.float64)
        return in_seconds(times, ", ".join(unit(one)) or parted(clock)[1], clock, f"{clock!r} of {path}")
    except Refused:
        raise
    except ValueError:
        return None, ""


def _why_not(one: Any) -> str:
    """Why an array is not read, empty if it may be."""
    if isinstance(one, str):
        return one
    if one.dtype.kind not in NUMERIC:
        return getattr(one, "what", f"of {one.dtype}")
    sides = _sides(one)
    if len(sides) > 2:
        return f"of {len(sides)} dimensions"
    return (
        f"a matrix of {sides[0]} times {sides[1]}" if min(sides[1:], default=0) > MOST_COLUMNS < sides[0] else ""
    )


def _sides(one: Any) -> list[int]:
    """The sides of an array of more than one entry; Simulink writes signals as 1 x 1 x samples."""
    return [side for side in one.shape if side != 1]


def _size(one: Any) -> tuple[int, int] | None:
    """The longer and the shorter side of a vector or matrix of numbers, None for anything else."""
    if _why_not(one) or 0 in one.shape or not (sides := _sides(one)):
        return None
    return max(sides), min(sides) if len(sides) == 2 else 1


def _is_time(name: str) -> bool:
    return parted(name.rpartition(".")[2])[0] in TIME_NAMES


def _clocks(name: str, vectors: Mapping[str, Mapping[str, int]]) -> Iterator[tuple[str, int]]:
    """Vectors of times that may be those of an array, and their lengths: beside it, then in groups around it."""
    group = name
    while group:
        group = group.rpartition(".")[0]
        yield from vectors.get(group, {}).items()


def _read(name: str, one: Any, path: Path) -> np.ndarray:
    """An array, of which sides of one entry are left out."""
    check_bytes(math.prod(one.shape) * max(one.dtype.itemsize, 8), f"the array {name!r}", path)
    return np.squeeze(np.asarray(one[...]))
