"""A monitor in a tuned file: its attributes as data, and the thresholds that follow from them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from filters.monitoring.monitor import Monitor, monitor_of
from filters.tuned_file import read_tuned_file
from thruster_env.core.checks import as_floats, short_repr

SAFELY = 2  # times the longest run of equal, or missing, readings of what is healthy
THRESHOLDS = "thresholds"


def monitor_for(measurements: np.ndarray, monitor: Monitor | None = None) -> Monitor:
    """A monitor whose `stuck` and `missing` are above those of healthy runs, twice the longest and one.

    Args:
        measurements: z of runs (B, K + 1, m), NaN where nothing was measured; what follows the last reading of a
            run does not count.
        monitor: the other attributes, and the least of these two.
    """
    monitor, equal, gone = monitor or Monitor(), 0, 0
    for run in as_floats(measurements):
        there = ~np.isnan(run)
        rows = int(np.flatnonzero(there.any(axis=1)).max(initial=-1)) + 1
        for z in run[:rows].T:
            readings = z[~np.isnan(z)]
            equal = max(equal, _longest(readings[1:] == readings[:-1]) + 1)
            gone = max(gone, _longest(np.isnan(z)))
    stuck, missing = SAFELY * equal + 1, SAFELY * gone + 1
    return replace(monitor, stuck=max(stuck, monitor.stuck), missing=max(missing, monitor.missing))


def _longest(flags: np.ndarray) -> int:
    """The longest run of true ones."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    return int((edges[1::2] - edges[::2]).max(initial=0))


def monitor_data(monitor: Monitor, channels: int) -> dict[str, Any]:
    """A monitor's attributes, and its thresholds by test, as JSON can hold them.

    Thresholds of `outlier` are those of one channel, two, ... that are there; of `variance` the least and the
    largest sum of a block.
    """
    _, cusum, glr, low, high, _, stuck, missing, *outliers = monitor.limits(channels).tolist()
    thresholds = {"outlier": outliers, "cusum": cusum, "glr": glr, "variance": [low, high]}
    return {**monitor.as_mapping(), THRESHOLDS: {**thresholds, "stuck": stuck, "missing": missing}}


def tuned_monitor(path: str | Path) -> Monitor:
    """The monitor of a tuned file.

    Raises:
        ValueError: for a file that cannot be read, or has none, as those of before version 0.1.
    """
    given = read_tuned_file(path).get("monitor")
    if given is None:
        raise ValueError(f"a tuned file must have a monitor (tune again, or give the steps), but {path} has none")
    if not isinstance(given, Mapping):
        raise ValueError(f"the monitor of a tuned file must be a mapping, but {path} has {short_repr(given)}")
    try:
        found = monitor_of({name: value for name, value in given.items() if name != THRESHOLDS})
    except ValueError as error:
        raise ValueError(f"{error} (in the tuned file {path})") from None
    return found or Monitor()
