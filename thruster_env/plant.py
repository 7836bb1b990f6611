"""The noisy plant: any number of thrusters advanced one sample time by one function, compiled or not.

    x_{k+1} = F(x_k, u_k) + w_k,  w ~ N(0, Q);      z_{k+1} = T(x_{k+1}) + v_{k+1},  v ~ N(0, R)

F integrates the equations of motion over one sample time. A single env is a batch of one copy, so the same
seed gives the same numbers on every path.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from typing import NamedTuple

import numpy as np

from thruster_env.checks import covariance, covariance_root, finite, positive, vector
from thruster_env.compiled import compiled, function_fingerprint, inlined, is_interpreting
from thruster_env.components import column_reader, column_writer, vector_reader
from thruster_env.dynamics import Constants, substep, thrust_and_torque
from thruster_env.linear import required_substeps, steady_state
from thruster_env.parameters import ThrusterParameters, derive_constants, preset_parameters
from thruster_env.streams import INITIAL, MEASUREMENT, PROCESS, normal_block

DEFAULT_DT = 0.01  # [s], the sample time of the published experiments
DEFAULT_MAX_VOLTAGE = 24.0  # [V]
# Tunnel, signal to noise: w stirs motor and flow by 0.5 % of their values at 12 V each step (in stationarity
# 1.15 rad/s and 0.035 m/s at 12 V); v is 0.5 N, 4 % of the thrust at 12 V, 16 % at 6 V and 65 % at 3 V.
DEFAULT_PROCESS_NOISE = (1.0, 4e-4)  # variances a step, [(rad/s)^2, (m/s)^2]
DEFAULT_MEASUREMENT_NOISE = 0.25  # variance, [N^2]
DEFAULT_INITIAL_VARIANCES = (1.0, 0.01)  # about rest, [(rad/s)^2, (m/s)^2]

# Rows of the memory (8, copies) of a batch of thrusters; rows 0 and 1 are omega_m [rad/s] and U_a [m/s].
THRUST, MEASURED, KEY_0, KEY_1, STEP, VOLTAGE = range(2, 8)
MEMORY_ROWS = 8


class Plant(NamedTuple):
    """A thruster with its noise, sampled every dt seconds; `make_plant` makes one from plain arguments."""

    parameters: ThrusterParameters
    dt: float  # [s]
    max_voltage: float  # [V]
    ambient_velocity: float  # [m/s]
    substeps: int  # Runge-Kutta steps a sample time
    process_noise_cov: np.ndarray  # (2, 2), a step
    measurement_noise_cov: np.ndarray  # (1, 1) [N^2]
    initial_mean: np.ndarray  # (2,)
    initial_cov: np.ndarray  # (2, 2)

    @property
    def constants(self) -> Constants:
        """Constants of the equations of motion, for one Runge-Kutta step."""
        return derive_constants(self.parameters, self.ambient_velocity, self.dt / self.substeps)

    @property
    def numbers(self) -> np.ndarray:
        """All that compiled steps need, as one float64 row: the constants, then the places named below."""
        q_root, initial_root = covariance_root(self.process_noise_cov), covariance_root(self.initial_cov)
        noise = [*q_root[np.tril_indices(2)], float(self.measurement_noise_cov[0, 0]) ** 0.5]
        initial = [*self.initial_mean, *initial_root[np.tril_indices(2)]]
        return np.array([*self.constants, self.substeps, self.max_voltage, *noise, *initial], dtype=np.float64)


def make_plant(
    preset: str | Mapping | ThrusterParameters = "tunnel",
    dt: float = DEFAULT_DT,
    max_voltage: float = DEFAULT_MAX_VOLTAGE,
    ambient_velocity: float = 0.0,
    process_noise_cov=DEFAULT_PROCESS_NOISE,
    measurement_noise_cov=DEFAULT_MEASUREMENT_NOISE,
    initial_state=None,
) -> Plant:
    """Make a plant from plain arguments, the same ones that the env takes.

    Args:
        preset: a preset's name, a mapping of all fields of `ThrusterParameters`, or one of these.
        dt: sample time [s].
        max_voltage: voltages are clipped to plus and minus this [V].
        ambient_velocity: flow U_0 along the thruster's axis [m/s].
        process_noise_cov: Q, covariance (2, 2) or two variances a step; zero allowed.
        measurement_noise_cov: R, variance of the thrust measurement [N^2]; zero allowed.
        initial_state: None for N(0, diag(1, 0.01)), a fixed state [omega_m, U_a], or a mapping:
            {"voltage": V} for the steady state of V volts, {"mean": [..], "cov": [..]} for a distribution.

    Raises:
        ValueError: states the rule and the value.
    """
    parameters = preset_parameters(preset)
    dt, max_voltage = positive("dt", dt), positive("max_voltage", max_voltage)
    ambient_velocity = finite("ambient_velocity", ambient_velocity)
    mean, cov = _initial_distribution(initial_state, parameters, ambient_velocity)
    return Plant(
        parameters,
        dt,
        max_voltage,
        ambient_velocity,
        required_substeps(parameters, dt, max_voltage, ambient_velocity),
        covariance("process_noise_cov", process_noise_cov, 2),
        covariance("measurement_noise_cov", measurement_noise_cov, 1),
        mean,
        cov,
    )


def _initial_distribution(initial_state, parameters, ambient_velocity) -> tuple[np.ndarray, np.ndarray]:
    if initial_state is None:
        return np.zeros(2), np.diag(DEFAULT_INITIAL_VARIANCES)
    if not isinstance(initial_state, Mapping):
        return vector("initial_state", initial_state, 2), np.zeros((2, 2))
    if set(initial_state) == {"voltage"}:
        voltage = finite("the voltage of initial_state", initial_state["voltage"])
        return np.array(steady_state(parameters, voltage, ambient_velocity)[:2]), np.zeros((2, 2))
    if set(initial_state) == {"mean", "cov"}:
        mean = vector("the mean of initial_state", initial_state["mean"], 2)
        return mean, covariance("the cov of initial_state", initial_state["cov"], 2)
    raise ValueError(
        "initial_state must be None, two numbers, {'voltage': V} or {'mean': [..], 'cov': [..]}, "
        f"but got {initial_state!r}"
    )


_CONSTANTS = len(Constants._fields)
SUBSTEPS, TOP_VOLTAGE, Q_ROOT_00, Q_ROOT_10, Q_ROOT_11, R_ROOT = range(_CONSTANTS, _CONSTANTS + 6)
MEAN_0, MEAN_1, PRIOR_ROOT_00, PRIOR_ROOT_10, PRIOR_ROOT_11 = range(_CONSTANTS + 6, _CONSTANTS + 11)

_read_constants = vector_reader(_CONSTANTS)
_column, _store = column_reader(2), column_writer(2)


@inlined
def _measure(memory, numbers, c):
    sigma = numbers[R_ROOT]
    for j in range(memory.shape[1]):
        thrust, _ = thrust_and_torque(_column(memory, j), c)
        v, _, _, _ = normal_block(0, memory[STEP, j], MEASUREMENT, memory[KEY_0, j], memory[KEY_1, j])
        memory[THRUST, j] = thrust
        memory[MEASURED, j] = thrust + sigma * v


@inlined
def begin_copies(memory, numbers):
    """Draw the initial state of every copy from its key, and take the first measurement."""
    c = Constants(*_read_constants(numbers))
    mean_0, mean_1 = numbers[MEAN_0], numbers[MEAN_1]
    root_00, root_10, root_11 = numbers[PRIOR_ROOT_00], numbers[PRIOR_ROOT_10], numbers[PRIOR_ROOT_11]
    for j in range(memory.shape[1]):
        w0, w1, _, _ = normal_block(0, 0, INITIAL, memory[KEY_0, j], memory[KEY_1, j])
        memory[0, j] = mean_0 + root_00 * w0
        memory[1, j] = mean_1 + root_10 * w0 + root_11 * w1
        memory[STEP, j] = 0.0
        memory[VOLTAGE, j] = 0.0
    _measure(memory, numbers, c)


@inlined
def advance_copies(memory, voltages, numbers):
    """Apply voltages (copies,) [V] for one sample time, add process noise, and measure."""
    c = Constants(*_read_constants(numbers))
    top = numbers[TOP_VOLTAGE]
    root_00, root_10, root_11 = numbers[Q_ROOT_00], numbers[Q_ROOT_10], numbers[Q_ROOT_11]
    for j in range(memory.shape[1]):
        memory[VOLTAGE, j] = min(max(voltages[j], -top), top)
    for _ in range(int(numbers[SUBSTEPS])):
        for j in range(memory.shape[1]):
            _store(memory, j, substep(_column(memory, j), (memory[VOLTAGE, j], c.ambient_velocity), c))
    for j in range(memory.shape[1]):
        memory[STEP, j] += 1.0
        w0, w1, _, _ = normal_block(0, memory[STEP, j], PROCESS, memory[KEY_0, j], memory[KEY_1, j])
        memory[0, j] += root_00 * w0
        memory[1, j] += root_10 * w0 + root_11 * w1
    _measure(memory, numbers, c)


def single_step() -> Callable:
    """Compiled `step(memory, voltage, numbers, begin)` of one thruster; memory is (8, 1), voltage in volts.

    It returns (omega_m, U_a, thrust, measurement, applied voltage) as floats.
    """
    return _single_step(is_interpreting())


@cache
def _single_step(interpreting: bool) -> Callable:
    fingerprint = function_fingerprint()

    def step(memory, voltage, numbers, begin):
        fingerprint  # noqa: B018 - part of the cache's key
        if begin:
            begin_copies(memory, numbers)
        else:
            voltages = np.empty(1)
            voltages[0] = voltage
            advance_copies(memory, voltages, numbers)
        return memory[0, 0], memory[1, 0], memory[THRUST, 0], memory[MEASURED, 0], memory[VOLTAGE, 0]

    return compiled(step)


@cache
def _batch_simulation(interpreting: bool) -> Callable:
    fingerprint = function_fingerprint()

    def simulate(keys, voltages, numbers, record):
        fingerprint  # noqa: B018 - part of the cache's key
        memory = np.zeros((MEMORY_ROWS, keys.shape[0]))
        memory[KEY_0, :] = keys[:, 0]
        memory[KEY_1, :] = keys[:, 1]
        for k in range(voltages.shape[0] + 1):
            if k == 0:
                begin_copies(memory, numbers)
            else:
                advance_copies(memory, voltages[k - 1], numbers)
            record[k] = memory[:4]

    return compiled(simulate)


class Simulation(NamedTuple):
    """Trajectories of a batch of B plants over K steps."""

    states: np.ndarray  # (B, K + 1, 2)
    thrusts: np.ndarray  # (B, K + 1) [N]
    measurements: np.ndarray  # (B, K + 1, 1) [N]


def simulate(plant: Plant, keys: np.ndarray, voltages: np.ndarray) -> Simulation:
    """Run a plant from its initial state for every key (B, 2) under voltages (B, K) [V].

    The same key and voltages give the same numbers as an env that is stepped through Gymnasium.

    Raises:
        ValueError: if shapes do not fit or a number is not finite.
    """
    keys, voltages = (np.ascontiguousarray(a, dtype=np.float64) for a in (keys, voltages))
    if keys.ndim != 2 or keys.shape[1] != 2 or not np.isfinite(keys).all():
        raise ValueError(f"keys must be finite and of shape (B, 2), but got shape {keys.shape}")
    if voltages.ndim != 2 or len(voltages) != len(keys) or np.isnan(voltages).any():
        rule = f"without NaN and of shape ({len(keys)}, K), one row a key"
        raise ValueError(f"voltages must be {rule}, but got shape {voltages.shape}")
    record = np.empty((voltages.shape[1] + 1, 4, len(keys)))
    _batch_simulation(is_interpreting())(keys, np.ascontiguousarray(voltages.T), plant.numbers, record)
    record = np.ascontiguousarray(record.transpose(2, 0, 1))
    return Simulation(record[..., :2], record[..., THRUST], record[..., MEASURED : MEASURED + 1])
