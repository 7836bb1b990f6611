"""A plant as JSON data, for files that record their plant, and differences between two plants."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from thruster_env.core.checks import short_repr
from thruster_env.effects.effects import Effect


class Entries(NamedTuple):
    """The entries of a plant's data; each plant has "preset", None or a name, and "parameters", a mapping."""

    essential: tuple[str, ...]  # what makes it another plant, on which Q and R mean nothing
    names: tuple[str, ...]  # all entries
    parameters: tuple[str, ...]  # names of the parameters


def check_same(entries: Entries, tuned_for: Mapping, data: Mapping, file: str | Path) -> list[str]:
    """Raise ValueError with the differences if a tuned file is for another plant; return minor differences.

    Args:
        entries: the entries of such plants' data.
        tuned_for: the file's data of a plant.
        data: those of the plant that it is used with.
        file: its path.
    """
    try:
        essential, further = differences(entries, tuned_for, data)
    except ValueError as error:
        raise ValueError(f"{error} (in the tuned file {file})") from None
    if essential:
        raise ValueError(
            f"a tuned file must be for the plant it is used with, but {file} was tuned for {', '.join(essential)}"
        )
    return further


def differences(entries: Entries, then: Mapping, now: Mapping) -> tuple[list[str], list[str]]:
    """Differences between the data of two plants, with both values: essential ones, and others.

    Raises:
        ValueError: if one of them lacks an entry.
    """
    for data in (then, now):
        if not isinstance(data, Mapping) or set(data) != set(entries.names):
            raise ValueError(f"a plant's data must have {', '.join(entries.names)}, but got {short_repr(data)}")
    compared = [name for name in entries.names if name not in ("preset", "parameters")]
    differing = [name for name in compared if not _alike(then[name], now[name])]
    essential = [_both(name, then[name], now[name]) for name in differing if name in entries.essential]
    further = [_both(name, then[name], now[name]) for name in differing if name not in entries.essential]
    return _parameters_that_differ(entries.parameters, then, now) + essential, further


def mappings(effects: tuple[Effect, ...]) -> list[dict]:
    """Effects as mappings for JSON."""
    return [effect.as_mapping() for effect in effects]


def _parameters_that_differ(known: tuple[str, ...], then: Mapping, now: Mapping) -> list[str]:
    """The presets if both have one, else the parameters."""
    earlier, later = (
        data["parameters"] if isinstance(data["parameters"], Mapping) else {} for data in (then, now)
    )
    names = [name for name in known if not _alike(earlier.get(name), later.get(name))]
    if names and then["preset"] is not None and now["preset"] is not None:
        return [_both("preset", then["preset"], now["preset"])]
    return [_both(name, earlier.get(name), later.get(name)) for name in names]


def _both(name: str, then, now) -> str:
    return f"{name} {_words(then)} (here {_words(now)})"


def _words(value) -> str:
    listed = isinstance(value, list) and value and all(isinstance(part, str) for part in value)
    return ", ".join(value) if listed else value if isinstance(value, str) else short_repr(value)


def _alike(first, other) -> bool:
    """Whether two JSON values are equal up to rounding."""
    if isinstance(first, Mapping) and isinstance(other, Mapping):
        return first.keys() == other.keys() and all(_alike(first[key], other[key]) for key in first)
    if isinstance(first, list) and isinstance(other, list):
        return len(first) == len(other) and all(map(_alike, first, other))
    if isinstance(first, int | float) and isinstance(other, int | float):
        return math.isclose(first, other, rel_tol=1e-9)
    return first == other
