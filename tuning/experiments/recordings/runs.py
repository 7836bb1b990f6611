"""The recorded runs: logs on the recorder's clock, the load cell on its own, and the recorder's estimates."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from thruster_env.logs.columns import MEASUREMENT
from thruster_env.logs.log import Log, at_offset
from thruster_env.logs.table import read_table
from tuning.experiments.recordings.model import AMBIENT, COMMAND, DT, LOAD_CELL, TACHOMETER

# The offset between the clocks of two recorders of the same quantity.


REACH, STEP = 0.15, 0.001  # range of offsets to either side of zero, and its step [s]
EDGES = 0.2  # left out at both ends, so that the shifted series covers all samples [s]


def clock_offset(times: np.ndarray, here: np.ndarray, other: np.ndarray) -> float:
    """The offset s [s] of least sum of squares of here(t) - other(t + s).

    Args:
        times: stamps (K,) [s], the same for both series, each by its own clock.
        here: samples by the reference clock.
        other: samples by the other clock, which are interpolated linearly.
    """
    counted = (times >= times[0] + EDGES) & (times <= times[-1] - EDGES) & np.isfinite(here)
    offsets = np.arange(-REACH, REACH + STEP / 2, STEP)
    known = np.isfinite(other)
    shifted = (np.interp(times[counted] + s, times[known], other[known]) for s in offsets)
    return float(offsets[np.argmin([((here[counted] - series) ** 2).mean() for series in shifted])])


def offset_by_halves(times: np.ndarray, here: np.ndarray, other: np.ndarray) -> tuple[float, float]:
    """The offset of each half of a run: their difference shows the accuracy."""
    middle = len(times) // 2
    halves = slice(None, middle), slice(middle, None)
    first, last = (clock_offset(times[half], here[half], other[half]) for half in halves)
    return first, last


FOLDER = "closed_loop_25Hz"
GATE = 0.12  # larger values of the flow sensor are taken to be wrong [m/s]
FLOW_RATE = 0.1  # weight of a new sample in the smoothed flow
# The recorder's thrust T = c_n n|n| - c_nv v|n| - c_v v|v|, for its two kinds of model (Boehm 2019).
OWN = (1.466934e-3, 0.4146275, 0.0)
OWN_NONLINEAR = (1.4657e-3, 0.375535, 37.7137)  # of runs named NLO2
UNKNOWN = "CL1state"  # runs so named had an estimator with other coefficients, which the files do not tell


class Recording(NamedTuple):
    """A closed-loop run of the recorded thruster."""

    name: str
    times: np.ndarray  # (K + 1,) stamps [s], of the recorder's rows and, by its own clock, of the load cell's
    command: np.ndarray  # (K + 1,) [V]
    flow: np.ndarray  # (K + 1,) [m/s], smoothed; zero without samples
    tachometer: np.ndarray  # (K + 1,) [rad/s], absolute value; NaN in row 0, which has no sample
    load: np.ndarray  # (K + 1,) [N], by the load cell's clock
    own: np.ndarray  # (K + 1,) [N], the recorder's on-line estimate, or the desired thrust where there is none
    own_is_desired: bool
    desired: np.ndarray  # (K + 1,) [N]
    offset: float  # of the load cell's clock, by the two tachometers [s]; positive if it is ahead
    halves: tuple[float, float]  # the same for each half of the run

    def log(self, ambient: bool = False) -> Log:
        """The run as a log on the recorder's clock, with the load cell as a channel, and the flow as an input."""
        inputs = np.column_stack([self.command, self.flow])[:-1, : 1 + ambient]
        log = Log(
            name=self.name,
            dt=DT,
            inputs=inputs,
            measurements=np.column_stack([self.tachometer, self.load]),
            input_quantities=(COMMAND, AMBIENT)[: 1 + ambient],
            measured=(TACHOMETER, LOAD_CELL),
        )
        return at_offset(log, f"{MEASUREMENT}:{LOAD_CELL.symbol}", self.offset)


def read_recordings(folder: str | Path) -> list[Recording]:
    """All closed-loop runs of a folder, or of its folder "closed_loop_25Hz", by name.

    Raises:
        ValueError: if there is no recording, or a file lacks a column.
    """
    folder = Path(folder)
    files = sorted((folder / FOLDER).glob("*.csv")) or sorted(folder.glob("*.csv"))
    if not files:
        raise ValueError(f"recordings must be .csv files in {folder} or its folder {FOLDER}, but there are none")
    return [read_recording(file) for file in files]


def read_recording(file: Path) -> Recording:
    """One run from its file."""
    table = read_table(file)
    wanted = {
        "times": "t_s",
        "command": "u_cmd_V",
        "flow": "y_flow_m_s",
        "tachometer": "y_tach_abs_rad_s",
        "load": "loadcell_thrust_N",
        "other_tachometer": "loadcell_tach_abs_rad_s",
        "desired": "Td_N",
        "speed": "authors_nhat_rad_s",
        "axial": "authors_vhat_axial_m_s",
    }
    missing = [header for header in wanted.values() if header not in table.names]
    if missing:
        raise ValueError(f"a recording must have the column {missing[0]}, but {file} has {', '.join(table.names)}")
    column = {name: table.numbers(header) for name, header in wanted.items()}
    tachometer = column["tachometer"].copy()
    tachometer[0] = np.nan
    both = column["times"], tachometer, column["other_tachometer"]
    own_thrust = _own_thrust(file.stem, column["speed"], np.nan_to_num(column["axial"]))
    none = bool(np.isnan(own_thrust).all())
    return Recording(
        name=file.stem,
        times=column["times"],
        command=column["command"],
        flow=_smoothed(column["flow"]),
        tachometer=tachometer,
        load=column["load"],
        own=column["desired"] if none else own_thrust,
        own_is_desired=none,
        desired=column["desired"],
        offset=clock_offset(*both),
        halves=offset_by_halves(*both),
    )


def _own_thrust(name: str, n: np.ndarray, v: np.ndarray) -> np.ndarray:
    if UNKNOWN in name:
        return np.full(len(n), np.nan)
    by_speed, by_both, by_flow = OWN_NONLINEAR if "NLO2" in name else OWN
    return by_speed * n * abs(n) - by_both * v * abs(n) - by_flow * v * abs(v)


def _smoothed(flow: np.ndarray) -> np.ndarray:
    """The ambient flow by a first-order lag over samples within the gate."""
    smoothed = np.zeros(len(flow))
    for k in range(1, len(flow)):
        wrong = not abs(flow[k]) <= GATE
        smoothed[k] = smoothed[k - 1] + (0.0 if wrong else FLOW_RATE * (flow[k] - smoothed[k - 1]))
    return smoothed
