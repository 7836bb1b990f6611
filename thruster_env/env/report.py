"""The parts of a step's report that an env shows: its rows for the observation and the info."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import cache
from typing import NamedTuple

import numpy as np

from thruster_env.core.written import written_out

FLOAT32_ENDS = 3e38  # casting beyond 3.4e38 would warn on its way to infinity


class ReportRows(NamedTuple):
    """Rows of a report, an array (reported,) or (reported, N), see `thruster_env.env.copies`."""

    measurement: slice  # of the m channels
    valid: slice  # whether each is valid
    dropping: tuple[int, ...]  # channels whose measurements may be missing; their validity stands in observations
    appended: tuple[int, ...]  # rows that stand last in the observation, such as a reference
    info: Mapping[str, int | slice]  # what info has, in order: a row for a number, several for a vector

    @property
    def states(self) -> int:
        """Number of states, for a plant whose info has them."""
        place = self.info["state"]
        return place.stop - place.start if isinstance(place, slice) else 1

    @property
    def flags(self) -> tuple[int, ...]:
        """Rows of the validity flags that observations have."""
        return tuple(self.valid.start + i for i in self.dropping)

    @property
    def observed(self) -> list[int]:
        """Rows that make the observation: measurements, then validity flags, then what the plant appends."""
        return [*range(self.measurement.start, self.measurement.stop), *self.flags, *self.appended]


def observation_of(values: list[float]) -> np.ndarray:
    """An observation (d,) in float32, infinite where a value is beyond its range or is not a number."""
    values = [value if abs(value) < FLOAT32_ENDS else -math.inf if value < 0 else math.inf for value in values]
    return np.array(values, dtype=np.float32)


def observations_of(report: np.ndarray, observed: list[int]) -> np.ndarray:
    """The same of N copies, (N, d), from rows of their report (reported, N)."""
    observations = np.empty((report.shape[1], len(observed)), dtype=np.float32)
    with np.errstate(over="ignore"):  # beyond 3.4e38 lies infinity
        for i, row in enumerate(observed):
            observations[:, i] = report[row]
    if np.isnan(observations.sum()):  # of a copy that terminates; a single env reports infinity, too
        observations[np.isnan(observations)] = np.inf
    return observations


def views_of(report: np.ndarray, rows: ReportRows) -> tuple[np.ndarray, ...]:
    """Views of the vectors in a report (reported,) that `info_maker` takes."""
    vectors = [report[place] for place in rows.info.values() if isinstance(place, slice)]
    return (*vectors, report[rows.valid])


def info_maker(rows: ReportRows) -> Callable[[np.ndarray, tuple[np.ndarray, ...]], dict]:
    """Return `info(report, views)`: the info of one copy, in separate arrays.

    It is generated for the plant's entries, because a step has to be fast. Numbers are NumPy scalars, because
    clients ask every value for its dtype.
    """
    places = tuple((name, None if isinstance(place, slice) else place) for name, place in rows.info.items())
    return _info_maker(places, bool(rows.dropping))


@cache
def _info_maker(places: tuple[tuple[str, int | None], ...], drops: bool) -> Callable:
    vectors = [name for name, place in places if place is None]
    entries = [
        f"{name!r}: views[{vectors.index(name)}].copy()" if place is None else f"{name!r}: report[{place}]"
        for name, place in places
    ]
    if drops:
        entries.append(f"'measurement_valid': views[{len(vectors)}] > 0.0")
    return written_out("info", "report, views", f"{{{', '.join(entries)}}}")


def infos_of(report: np.ndarray, rows: ReportRows, mask: np.ndarray) -> dict[str, np.ndarray]:
    """The same of N copies: arrays with one row per copy, and the mask (N,) as `_key` for each key."""
    info = {name: report[place].T for name, place in rows.info.items()}
    if rows.dropping:
        info["measurement_valid"] = report[rows.valid].T > 0.0
    return info | {f"_{key}": mask for key in info}
