"""What is assumed of the recorded ROV thruster: a motor, the water that it moves, its tachometer and its mount.

    dn/dt = k_n (g d(u) - n)                             motor speed n [rad/s] under the command u [V]
    dy/dt = (n - y)/tau                                  what the tachometer shows, but for the sign
    B = e(n) (c_n n|n| - c_v (v - v_a)|n|)               thrust of the blades [N]
    T = B + a dn/dt                                      thrust on the water [N]
    dv/dt = -k_v v - k_vv v|v| + k_t B                   axial flow v [m/s]
    d2q/dt2 = w^2 (T - q) - 2 zeta w dq/dt               what the mount passes on [N]

with d(u) = u - high above the dead band, b (u - low) below it and 0 within; e(n) = 1 ahead and e astern. The load
cell shows T + m (q - T). An effect whose constant is neutral is not there: a, m, c_v of 0; b, e of 1.

v has no scale of its own where only thrust is measured: c_v, k_vv and k_t change with it. k_t is therefore held.

Source of motor, dead band, blades and flow: J. A. Boehm (2019), MSc thesis, University of Maryland. The numbers of
`identified.toml` are ours, found from the recordings (docs/real_data.md).
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np

from thruster_env.core.derivatives import runge_kutta
from thruster_env.logs.columns import MEASUREMENT
from thruster_env.logs.log import Log, at_offset
from thruster_env.logs.table import read_table
from thruster_env.model.quantities import Output, Quantity
from thruster_env.model.state_space import StateSpaceModel
from tuning.likelihood.result import read_values, valued

DT = 0.04  # of the recordings [s]
SUBSTEPS = 4  # of 10 ms: stable for rates of up to 278 1/s
IDENTIFIED = Path(__file__).with_name("identified.toml")
STATES = (
    Quantity("motor speed", "n", "rad/s"),
    Quantity("tachometer speed", "y", "rad/s"),
    Quantity("axial flow", "v", "m/s"),
    Quantity("effective command", "d", "V"),
)
MOUNT = (
    Quantity("force in the mount", "q", "N"),
    Quantity("rate of the force in the mount", "r", "N/s"),
)
INITIAL = (30.0, 30.0, 0.03, 0.0), (5.0, 200.0)  # standard deviations, of the mount last
PROCESS = (5.0, 1.0, 3e-3, 0.0), (0.0, 0.0)  # standard deviations of the noise of a step
COMMAND = Quantity("command", "u", "V")
AMBIENT = Quantity("measured ambient flow", "flow", "m/s")
TACHOMETER = Quantity("motor speed without its sign", "tach", "rad/s")
LOAD_CELL = Quantity("load cell", "load", "N")
SENSORS = (1.8, 1.0)  # standard deviations of tachometer [rad/s] and load cell [N]

# Of the offset between two clocks.
REACH, STEP = 0.15, 0.001  # range of offsets to either side of zero, and its step [s]
EDGES = 0.2  # left out at both ends, so that the shifted series covers all samples [s]

# Of the recorded runs.
FOLDER = "closed_loop_25Hz"
GATE = 0.12  # larger values of the flow sensor are taken to be wrong [m/s]
FLOW_RATE = 0.1  # weight of a new sample in the smoothed flow
# The recorder's thrust T = c_n n|n| - c_nv v|n| - c_v v|v|, for its two kinds of model (Boehm 2019).
OWN = (1.466934e-3, 0.4146275, 0.0)
OWN_NONLINEAR = (1.4657e-3, 0.375535, 37.7137)  # of runs named NLO2
UNKNOWN = "CL1state"  # runs so named had an estimator with other coefficients, which the files do not tell


class Constants(NamedTuple):
    """Numbers of the model; those given here are round ones to start from."""

    motor_rate: float = 60.0  # k_n [1/s]
    motor_gain: float = 51.0  # g [rad/(s V)]
    gain_ratio: float = 1.0  # b
    dead_band_low: float = -0.8  # [V]
    dead_band_high: float = 0.8  # [V]
    tachometer_lag: float = 0.04  # tau [s]
    thrust_factor: float = 1.5e-3  # c_n [N s^2]
    thrust_ratio: float = 1.05  # e
    flow_factor: float = 0.4  # c_v [N s^2/m]
    flow_linear: float = 1.0  # k_v [1/s]
    flow_quadratic: float = 20.0  # k_vv [1/m]
    flow_gain: float = 0.03  # k_t [1/kg]
    ambient_factor: float = 0.0  # v_a over the measured ambient flow
    inertia: float = 0.0  # a [N s^2]
    mount_share: float = 0.0  # m
    mount_frequency: float = 14.0  # w/2 pi [Hz]
    mount_damping: float = 0.1  # zeta
    substep: float = DT / SUBSTEPS  # [s]


def effective(command, c):
    """The command beyond the dead band [V]."""
    if command > c.dead_band_high:
        return command - c.dead_band_high
    if command < c.dead_band_low:
        return c.gain_ratio * (command - c.dead_band_low)
    return 0.0


def blades(n, v, c):
    """Thrust of the blades at a speed and a flow through them [N]."""
    side = 1.0 + (c.thrust_ratio - 1.0) * (n < 0.0)
    return side * (c.thrust_factor * n * abs(n) - c.flow_factor * v * abs(n))


def acceleration(x, c):
    """Of the motor [rad/s^2]."""
    return c.motor_rate * (c.motor_gain * x[3] - x[0])


def thrust(x, c):
    """Thrust on the water [N]."""
    return blades(x[0], x[2], c) + c.inertia * acceleration(x, c)


def through_mount(x, c):
    """What the load cell shows where the mount swings [N]."""
    return thrust(x, c) * (1.0 - c.mount_share) + c.mount_share * x[4]


def rates(x, u, c):
    """How fast the state changes under u = (effective command, ambient flow)."""
    lift = blades(x[0], x[2] - c.ambient_factor * u[1], c)
    return (
        acceleration(x, c),
        (x[0] - x[1]) / c.tachometer_lag,
        c.flow_gain * lift - (c.flow_linear + c.flow_quadratic * abs(x[2])) * x[2],
        0.0,
    )


def rates_with_mount(x, u, c):
    """How fast the state and the force in the mount change."""
    w = 2.0 * math.pi * c.mount_frequency
    swing = w * w * (thrust(x, c) - x[4]) - 2.0 * c.mount_damping * w * x[5]
    dn, dy, dv, dd = rates(x, u, c)
    return dn, dy, dv, dd, x[5], swing


_step, _step_with_mount = runge_kutta(rates, 4), runge_kutta(rates_with_mount, 6)


def transition(x, u, c):
    """One of the equal parts of a step under the command."""
    return _step((x[0], x[1], x[2], effective(u[0], c)), (u[0], 0.0), c)


def transition_in_flow(x, u, c):
    """One of the equal parts of a step under command and measured ambient flow."""
    return _step((x[0], x[1], x[2], effective(u[0], c)), (u[0], u[1]), c)


def transition_with_mount(x, u, c):
    """One of the equal parts of a step of thruster and mount."""
    return _step_with_mount((x[0], x[1], x[2], effective(u[0], c), x[4], x[5]), (u[0], 0.0), c)


def tachometer(x, c):
    """What the tachometer shows."""
    return (abs(x[1]),)


def tachometer_and_load(x, c):
    """What tachometer and load cell show."""
    return (abs(x[1]), thrust(x, c))


def tachometer_and_mount(x, c):
    """What tachometer and load cell show where the mount swings."""
    return (abs(x[1]), through_mount(x, c))


def to_identify(ambient: bool = False, mount: bool = False) -> StateSpaceModel:
    """The model with the load cell among its channels and round numbers, from which identification starts.

    Args:
        ambient: whether the measured ambient flow is an input.
        mount: whether the mount swings, which is two states more; not along with ambient flow.
    """
    parts = 1 + mount
    move = transition_with_mount if mount else transition_in_flow if ambient else transition
    return StateSpaceModel(
        transition=move,
        observe=tachometer_and_mount if mount else tachometer_and_load,
        process_noise_cov=[deviation**2 for part in PROCESS[:parts] for deviation in part],
        measurement_noise_cov=[deviation**2 for deviation in SENSORS],
        prior_mean=[0.0] * (4 + 2 * mount),
        prior_cov=[deviation**2 for part in INITIAL[:parts] for deviation in part],
        inputs=1 + ambient,
        constants=Constants(),
        substeps=SUBSTEPS,
        states=STATES + MOUNT * mount,
        input_quantities=(COMMAND, AMBIENT)[: 1 + ambient],
        measurements=(TACHOMETER, LOAD_CELL),
        outputs={"T": Output(Quantity("thrust", "T", "N"), thrust)},
    )


def on_line(identified: StateSpaceModel) -> StateSpaceModel:
    """An identified model as a filter has it that sees the tachometer alone."""
    r = identified.measurement_noise_cov[:1, :1]
    return identified.replace(observe=tachometer, measurements=(TACHOMETER,), measurement_noise_cov=r)


def model() -> StateSpaceModel:
    """The thruster with the numbers of `identified.toml`, for a filter that sees command and tachometer.

    Its output T is the thrust; a load cell's column may be its reference (`--column T=HEADER`).
    """
    return on_line(valued(to_identify(), read_values(IDENTIFIED)))


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
