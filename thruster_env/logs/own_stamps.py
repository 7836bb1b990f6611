"""A log's rows at the times of its samples, without a grid.

A row is a time at which any channel has a sample; a channel's clock offset is subtracted from its stamps first.
The first row has the first stamp of the file, and what was sampled before it or after the last one is left out.
Inputs are held from sample to sample, before the first at its value. Nothing is moved, averaged or interpolated.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np

from thruster_env.core.stamps import closeness, resolution_of
from thruster_env.logs.grid import Series


def at_own_stamps(
    series: Mapping[str, Series],
    inputs: Collection[str],
    offsets: Mapping[str, float],
    dt: float,
    end: float,
    start: float = 0.0,
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """The times (K + 1,) [s] of a log's rows, and each channel at them: inputs (K,), others (K + 1,) with NaN.

    Args:
        series: samples by channel, at times since the first stamp.
        inputs: channels that are inputs.
        offsets: clock offsets by channel [s].
        dt: sample time [s]: stamps that are within a billionth of it, or their rounding, are one.
        end: the last stamp [s].
        start: the first stamp [s], as the file has it.
    """
    near = closeness(dt, resolution_of(abs(start) + end))
    own = {key: one.times - offsets.get(key, 0.0) for key, one in series.items()}
    stamps = np.sort(np.concatenate([np.zeros(1), *own.values()]))
    stamps = stamps[(stamps >= -near) & (stamps <= end + near)]
    times = stamps[np.append(True, np.diff(stamps) > near)]
    times[0] = 0.0
    columns = {}
    for key, one in series.items():
        if key in inputs:
            place = np.searchsorted(own[key], times[:-1] + near, side="right") - 1
            columns[key] = one.values[np.maximum(place, 0)]
            continue
        within = (own[key] >= -near) & (own[key] <= end + near)
        place = np.searchsorted(times, own[key][within] + near, side="right") - 1
        columns[key] = np.full(len(times), np.nan)
        columns[key][place] = one.values[within]  # of two of one time the last
    return times, columns
