"""A plant from plain arguments and as JSON data: what all plants share.

Sensors and initial state of arguments; data for files that record their plant, and differences between two plants.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from thruster_env.core.checks import as_floats, covariance, one_of, positive, short_repr, vector, within
from thruster_env.effects.effects import Registry
from thruster_env.model.quantities import Quantity

LARGEST_WEIGHT = 1e9
LARGEST_STATE = 1e50  # in SI units: beyond it floating point may overflow; its square of a variance


def checked_state(name: str, value, count: int) -> np.ndarray:
    """Return a state (count,); raise ValueError unless it is so many numbers from which finite ones can follow."""
    entries = vector(name, value, count)
    if np.abs(entries).max() > LARGEST_STATE:
        raise ValueError(f"{name} must be within plus and minus {LARGEST_STATE:g}, but got {short_repr(value)}")
    return entries


def checked_noise(name: str, value, count: int) -> np.ndarray:
    """A covariance (count, count) from a matrix or from variances; zero is allowed."""
    return covariance(name, value, count, largest=LARGEST_STATE**2)


def initial_distribution(
    initial_state,
    default: tuple[np.ndarray, np.ndarray],
    count: str,
    key: str,
    letter: str,
    mean_of: Callable,
) -> tuple[np.ndarray, np.ndarray]:
    """Mean (n,) and covariance (n, n) of the initial state, from an env's argument.

    Args:
        initial_state: None, n numbers, a mapping with the plant's own key, or with "mean" and "cov".
        default: mean and covariance for None.
        count: n in words, for messages.
        key: the plant's own key, "voltage".
        letter: of its value in messages, "V".
        mean_of: `mean_of(value)` is the state that the plant's own key fixes.

    Raises:
        ValueError: for another argument.
    """
    n = len(default[0])
    fixed = np.zeros((n, n))
    if initial_state is None:
        return default
    if not isinstance(initial_state, Mapping):
        return checked_state("initial_state", initial_state, n), fixed
    if set(initial_state) == {key}:
        return mean_of(initial_state[key]), fixed
    if set(initial_state) == {"mean", "cov"}:
        mean = checked_state("the mean of initial_state", initial_state["mean"], n)
        return mean, checked_noise("the cov of initial_state", initial_state["cov"], n)
    raise ValueError(
        f"initial_state must be None, {count} numbers, {{{key!r}: {letter}}} or {{'mean': [..], 'cov': [..]}}, "
        f"but got {short_repr(initial_state)}"
    )


def checked_weights(**weights: float) -> tuple[float, ...]:
    """The weights of a reward's terms by name; ValueError for a negative one, or one above LARGEST_WEIGHT."""
    return tuple(
        within(f"{name}_weight", positive(f"{name}_weight", value, zero_allowed=True), LARGEST_WEIGHT)
        for name, value in weights.items()
    )


def sensor_effects(sensors: Mapping, channels: Mapping, registry: Registry, most: int) -> dict[str, tuple]:
    """Effects of each measured channel, from a mapping of at most so many channels to lists of effects."""
    if not sensors:
        raise ValueError("sensors must name at least one channel, but got none")
    if len(sensors) > most:
        raise ValueError(f"sensors must name at most {most} channels, but got {len(sensors)}")
    return {
        one_of("a channel of sensors", channel, tuple(channels)): registry.make(effects)
        for channel, effects in sensors.items()
    }


class Entries(NamedTuple):
    """The entries of a plant's data; each plant has "preset", None or a name, and "parameters", a mapping."""

    essential: tuple[str, ...]  # what makes it another plant, on which Q and R mean nothing
    names: tuple[str, ...]  # all entries
    parameters: tuple[str, ...]  # names of the parameters


def data_of(plant: Any, entries: Entries, presets: Mapping, **further) -> dict:
    """The data on which a filter's parameters depend: plant, sample time, sensors, noise and disturbances.

    Initial state, task and seed are not part of it. An entry is the plant's attribute of its name, unless
    `further` has it.
    """
    preset = next((name for name, parameters in presets.items() if parameters == plant.parameters), None)
    data = {"preset": preset, "sensors": plant.channels, "sensor_effects": plant.sensors, **further}
    values = {name: as_json(data[name] if name in data else getattr(plant, name)) for name in entries.names}
    return json.loads(json.dumps(values, default=np.ndarray.tolist))  # lists for tuples, as a file has them


def as_json(value):
    """An argument of an env for JSON, effects and parameters as mappings of plain numbers."""
    if hasattr(value, "as_mapping"):
        return value.as_mapping()
    if hasattr(value, "_asdict"):
        return value._asdict()
    if isinstance(value, Mapping):
        return {key: as_json(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [as_json(entry) for entry in value]
    return value


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


def some_numbers(action, quantities: tuple[Quantity, ...]) -> np.ndarray:
    """The commands (p,) of a plant with p inputs; ValueError unless an action is p numbers, none of them NaN."""
    try:
        numbers = as_floats(action)
    except ValueError:
        numbers = np.empty(0)
    if numbers.shape != (len(quantities),) or np.isnan(numbers).any():
        rule = f"{len(quantities)} numbers and not NaN ({_labels(quantities)})"
        raise ValueError(f"an action must be {rule}, but got {short_repr(action)}")
    return numbers


def of_copies(actions, copies: int, quantities: tuple[Quantity, ...], ignored: np.ndarray | None) -> np.ndarray:
    """Commands (copies, p) of many copies, or (copies,) if p is 1.

    Args:
        actions: (copies, p), or (copies,) if p is 1.
        copies: their number.
        quantities: the p inputs.
        ignored: copies (copies,) whose actions are not used, and may be NaN; None if there are none.

    Raises:
        ValueError: for another shape, and for NaN.
    """
    p = len(quantities)
    try:
        commands = as_floats(actions)
    except ValueError:
        commands = np.empty(0)
    if commands.shape != (copies, p) and (p > 1 or commands.shape != (copies,)):
        raise ValueError(f"actions must be {copies} {_rows(quantities)}, but got {short_repr(actions)}")
    wrong = np.isnan(commands)
    if wrong.any():
        lost = wrong.reshape(copies, -1).any(axis=1)
        lost_copies = np.flatnonzero(lost if ignored is None else lost & ~ignored)
        if len(lost_copies):
            raise ValueError(
                f"actions must be {_rows(quantities)} and not NaN, but got NaN in copy {lost_copies[0]}"
            )
    return commands.reshape(-1) if p == 1 else commands


def _rows(quantities: tuple[Quantity, ...]) -> str:
    """The words for one row of actions in messages."""
    if len(quantities) == 1:
        return f"{quantities[0].name}s [{quantities[0].unit}]"
    return f"rows of {len(quantities)} numbers ({_labels(quantities)})"


def _labels(quantities: tuple[Quantity, ...]) -> str:
    return ", ".join(quantity.label for quantity in quantities)
