"""The runs of the papers on the vehicle: the form of a table, and the settings of both papers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

DT = 0.001  # [s]
NOISE = 1e-6  # Q = R = 1e-6 I, in the units of the velocities squared
MEASURED = ("u", "v", "w", "r")  # H picks these
POSE = ("x", "y", "z", "psi")  # [m], [m], [m], [rad]
FUZZY_LOW, FUZZY_HIGH = (0.0,) * 6, (1.0,) * 6  # bounds of the velocities; the rules are the corners
RUNS = 10  # "mean of 10 runs"
NOT_PRINTED = (
    "number of steps",
    "thrust, propeller torque and stern plane",
    "P_0",
    "the vehicle's coefficients and restoring moments",
    "what the reference paths are",
    "how measurements were made",
    "what RMSE and percent are taken over",
)


class PrintedRow(NamedTuple):
    """One filter on one path."""

    rmse: Mapping[str, float]  # by component of the pose: x, y, z [m], psi [rad]; not every table has all
    seconds: float
    final_percent: Mapping[str, float] = {}  # error at the end over the path's end, it seems


class PrintedPath(NamedTuple):
    """Ensemble and fuzzy Kalman filter on one path."""

    enkf: PrintedRow
    fkf: PrintedRow
    remark: str = ""  # misprint, or how it was interpreted


class Paper(NamedTuple):
    """A source with remarks for its readers."""

    name: str
    source: str
    remarks: tuple[str, ...]
