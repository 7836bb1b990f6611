"""Recorded runs as one batch: runs of different lengths are padded with steps in which nothing is measured."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from thruster_env.core.checks import short_repr
from thruster_env.core.streams import filter_keys
from thruster_env.logs.log import Log
from thruster_env.logs.steps import in_steps
from tuning.problems.data import Data, mask_of, padded
from tuning.problems.log_checks import check_times


def runs_of(data: Data | Log | Sequence[Data | Log]) -> Data:
    """Data and logs as one `Data`; keys and seeds are those of the runs' indices 0, 1, ...

    Logs on their own stamps have step ratios as their last input (`thruster_env.logs.steps`).

    Raises:
        ValueError: for anything else, for no run, for runs with different inputs, measurements or sample times.
    """
    given = _listed(data)
    if not given or not all(isinstance(one, Data | Log) for one in given):
        raise ValueError(f"data must be some of Log or Data, but got {short_repr(data)}")
    if len(given) == 1 and isinstance(given[0], Data):
        return given[0].seen
    check_times([one for one in given if isinstance(one, Log)])
    inputs: list[np.ndarray] = []
    measurements: list[np.ndarray] = []
    for one in given:
        if isinstance(one, Log):
            u, z = (one.inputs, one.measurements) if one.stamps is None else in_steps(one)
            inputs, measurements = [*inputs, u], [*measurements, z]
            continue
        for part in map(one.one, range(len(one.seeds))):
            inputs += list(part.inputs)
            measurements += list(part.measurements)
    lengths = list(map(len, measurements))
    widths = {(u.shape[1], z.shape[1]) for u, z in zip(inputs, measurements, strict=True)}
    if len(widths) > 1:
        raise ValueError(f"runs must have the same inputs and measurements, but got {sorted(widths)} of each")
    rows, seeds = max(map(len, measurements)), tuple(range(len(inputs)))
    all_inputs, all_measurements = padded(inputs, rows - 1, None), padded(measurements, rows)
    return Data(seeds, all_inputs, all_measurements, filter_keys(seeds), 0, counted=mask_of(lengths, rows))


def _listed(data: Any) -> list[Data | Log]:
    """One or several runs as a list; empty for what is neither."""
    if isinstance(data, Data | Log):
        return [data]
    return list(data) if isinstance(data, Sequence) else []
