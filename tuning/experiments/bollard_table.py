"""Reads a thruster's bollard table: thrust, speed and current for pulse widths and supply voltages."""

from __future__ import annotations

import csv
import math
from pathlib import Path
from typing import NamedTuple

import numpy as np

from thruster_env.core.checks import short_repr

COLUMNS = ("pwm_us", "rpm", "current_A", "voltage_V", "force_kgf")
CENTRE, SPAN = 1500.0, 400.0  # pulse width at rest, and from there to full throttle [us]
SLOWEST = 0.25  # fraction of full speed; slower rows are not used
STANDARD_GRAVITY = 9.80665  # m/s^2, N in a kgf


class BollardTable(NamedTuple):
    """The rows of a bollard table that are fast enough to be used, arrays of one shape (n,).

    Speed and thrust are positive in both directions: `ahead` has the sign.
    """

    ahead: np.ndarray  # bool
    pulse_width: np.ndarray  # [us]
    supply: np.ndarray  # [V]
    speed: np.ndarray  # of the propeller [rad/s]
    thrust: np.ndarray  # [N]
    current: np.ndarray  # from the supply [A]

    def select(self, mask) -> BollardTable:
        """The rows where a mask (n,) is true."""
        return BollardTable(*(column[mask] for column in self))


def read_table(path) -> BollardTable:
    """Read a table with the columns of COLUMNS, in any order; other columns are ignored.

    Pulse widths above 1500 us are ahead, below astern, where the force is negative. Of each supply voltage and
    direction the rows above a quarter of its full speed are kept.

    Raises ValueError with the file, and with the line if possible, if this is not such a table.
    """
    path = Path(path)
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file)
            missing = [name for name in COLUMNS if name not in (reader.fieldnames or ())]
            if missing:
                raise ValueError(
                    f"{path} must have the columns {', '.join(COLUMNS)}, but lacks {', '.join(missing)}"
                )
            rows = [_numbers(row, f"{path}, line {reader.line_num}") for row in reader]
    except OSError as error:
        raise ValueError(f"{path} cannot be read: {error.strerror}") from None
    except (UnicodeDecodeError, csv.Error):
        raise ValueError(f"{path} must be a text file of comma-separated values") from None
    if not rows:
        raise ValueError(f"{path} must have rows, but has only a heading")
    pulse_width, rpm, current, supply, force = np.array(rows).T
    ahead = pulse_width > CENTRE
    table = BollardTable(
        ahead,
        pulse_width,
        supply,
        rpm * (2 * math.pi / 60),
        np.where(ahead, force, -force) * STANDARD_GRAVITY,
        current,
    )
    table = table.select(_fast(table))
    if not ((table.thrust > 0) & (table.current > 0)).all():
        raise ValueError(
            f"{path} must have force_kgf in the direction of its pwm_us, and current_A above zero, wherever rpm "
            "is above a quarter of full speed"
        )
    return table


def _numbers(row: dict, place: str) -> list[float]:
    """The values of COLUMNS in a row."""
    try:
        values = [float(row[name]) for name in COLUMNS]
    except (TypeError, ValueError):
        values = [math.nan]
    if not all(map(math.isfinite, values)):
        raise ValueError(
            f"{place}: {', '.join(COLUMNS)} must be numbers, but are {short_repr([row[n] for n in COLUMNS])}"
        )
    return values


def _fast(table: BollardTable) -> np.ndarray:
    """Rows (n,) above the slowest speed; the propeller must turn in both directions at each supply."""
    fast = np.zeros(len(table.speed), dtype=bool)
    for supply in np.unique(table.supply):
        for ahead in (True, False):
            rows = (table.supply == supply) & (table.ahead == ahead) & (table.pulse_width != CENTRE)
            full = table.speed[rows].max(initial=0.0)
            if full == 0:
                raise ValueError(f"the propeller must turn {'ahead' if ahead else 'astern'} at {supply:g} V")
            fast |= rows & (table.speed > SLOWEST * full)
    return fast
