"""What a picture shows: moments, what a filter believes of them, and the last of both."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

STEPS = 500  # that are remembered; 5 s at the default sample time
ABSURD = 1e12  # states and estimates can diverge; beyond this a number is not drawn


class Moment(NamedTuple):
    """The truth at the end of a step, one entry of the strip charts."""

    time: float  # since the start of the episode [s]
    omega_m: float  # motor speed [rad/s]
    U_a: float  # section-average flow velocity [m/s]
    thrust: float  # [N]
    measured_thrust: float  # [N]
    reference: float | None  # thrust to hold [N]
    voltage: float  # [V]
    ambient_velocity: float = 0.0  # U_0 [m/s]


class Overlay(NamedTuple):
    """What a filter believes of a moment; None where it believes nothing."""

    label: str  # name of the filter in the legend
    thrust: float | None = None  # [N]
    thrust_std: float | None = None  # standard deviation [N]
    omega_m: float | None = None  # [rad/s]
    omega_m_std: float | None = None  # [rad/s]
    U_a: float | None = None  # [m/s]
    U_a_std: float | None = None  # [m/s]


# What is remembered: the truth under its own name, beliefs as estimated_NAME and estimated_NAME_std.
COLUMNS = Moment._fields + tuple(f"estimated_{name}" for name in Overlay._fields[1:])


class History:
    """The last moments of an episode."""

    def __init__(self):
        self._rows = np.empty((STEPS, len(COLUMNS)))
        self.clear()

    def clear(self) -> None:
        """Forget all of it."""
        self.count = 0  # moments added
        self.label = ""  # name of the filter

    def add(self, moment: Moment) -> None:
        """Note a moment."""
        row = self._rows[self.count % STEPS]
        row[: len(moment)] = moment  # None becomes NaN
        row[len(moment) :] = math.nan
        self.count += 1

    def amend(self, overlay: Overlay) -> None:
        """Note what a filter believes of the moment added last."""
        self.label = overlay.label
        self._rows[(self.count - 1) % STEPS, len(Moment._fields) :] = overlay[1:]

    def columns(self) -> dict[str, np.ndarray]:
        """An array (n,) for each of COLUMNS, oldest first, NaN where there is no value that can be drawn."""
        full = self.count > STEPS
        rows = np.roll(self._rows, -self.count, axis=0) if full else self._rows[: self.count]
        return dict(zip(COLUMNS, np.where(np.abs(rows) < ABSURD, rows, math.nan).T, strict=True))


def newest(columns: dict[str, np.ndarray], name: str) -> float:
    """The newest value of a column; that of the step before if a filter has not got to the last step yet."""
    last = columns[name][-2:]
    known = last[np.isfinite(last)]
    return float(known[-1]) if len(known) else math.nan
