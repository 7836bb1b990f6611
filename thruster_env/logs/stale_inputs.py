"""Inputs that are held over a log, or over its end, because they have no samples there."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from thruster_env.logs.findings import STALE, Remark
from thruster_env.logs.grid import CLOSE, Series
from thruster_env.logs.stamps import time_text

LONG = 0.1  # of the log at its end
LONGER = 10.0  # than the longest time between two samples of the input


def stale_inputs(inputs: Mapping[str, Series], end: float, dt: float, start: float) -> list[Remark]:
    """Inputs without a sample after the first row, or in the last part of the log.

    An input whose clock is not that of the measurements looks like this, but so does a constant one that is sent
    once.

    Args:
        inputs: samples by channel, at times since row 0 [s].
        end: time of the last row since row 0 [s].
        dt: sample time [s].
        start: time stamp of row 0 [s].
    """
    remarks = []
    for key, one in inputs.items():
        name, last = key.partition(":")[2], float(one.times[-1])
        if last <= CLOSE * dt:
            said = f"{name} has no sample after the first row: it is held at {one.values[-1]:.6g} in all rows"
            remarks.append(Remark(STALE, key, said))
        elif end - last > max(LONG * end, LONGER * float(np.diff(one.times).max(initial=dt))):
            begun = time_text(start + last, dt)
            said = f"{name} has no sample after {begun} s: it is held at {one.values[-1]:.6g} for the last "
            remarks.append(Remark(STALE, key, f"{said}{end - last:.4g} s"))
    return remarks
