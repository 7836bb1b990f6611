"""Recorded runs as one batch: runs of different lengths are padded with steps in which nothing is measured."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from numerics.checks import shown
from numerics.streams import filter_keys
from plants.logs.log import Log
from tuning.problems.data import Data


def runs_of(data: Data | Log | Sequence[Data | Log]) -> Data:
    """Data and logs as one `Data`; keys and seeds are those of the runs' indices 0, 1, ...

    Raises:
        ValueError: for anything else, for no run, or for runs with different inputs, measurements or sample times.
    """
    given = _listed(data)
    if not given or not all(isinstance(one, Data | Log) for one in given):
        raise ValueError(f"data must be some of Log or Data, but got {shown(data)}")
    if len(given) == 1 and isinstance(given[0], Data):
        return given[0]
    times = sorted({one.dt for one in given if isinstance(one, Log)})
    if times and times[-1] > times[0] * (1 + 1e-6):
        raise ValueError(f"logs must have one sample time, but got {', '.join(f'{dt:g} s' for dt in times)}")
    inputs: list[np.ndarray] = []
    measurements: list[np.ndarray] = []
    for one in given:
        inputs += [one.inputs] if isinstance(one, Log) else list(one.inputs)
        measurements += [one.measurements] if isinstance(one, Log) else list(one.measurements)
    widths = {(u.shape[1], z.shape[1]) for u, z in zip(inputs, measurements, strict=True)}
    if len(widths) > 1:
        raise ValueError(f"runs must have the same inputs and measurements, but got {sorted(widths)} of each")
    ((p, m),) = widths
    steps, seeds = max(map(len, inputs)), tuple(range(len(inputs)))
    all_inputs, all_measurements = np.zeros((len(seeds), steps, p)), np.full((len(seeds), steps + 1, m), np.nan)
    for place, (u, z) in enumerate(zip(inputs, measurements, strict=True)):
        all_inputs[place, : len(u)], all_inputs[place, len(u) :] = u, u[-1:]
        all_measurements[place, : len(z)] = z
    return Data(seeds, all_inputs, all_measurements, filter_keys(seeds), 0)


def _listed(data: Any) -> list[Data | Log]:
    """One or several runs as a list; empty for what is neither."""
    if isinstance(data, Data | Log):
        return [data]
    return list(data) if isinstance(data, Sequence) else []
