"""Plant and task as one row of numbers, the form that compiled steps read; offsets are in `memory`."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np

from thruster_env.auv.channels import CHANNELS, MAX_CHANNELS, MEASURED, STATES, SYMBOLS
from thruster_env.auv.effects import CURRENT_SIGNALS, DIRECTIONS, VEHICLE_SENSOR_EFFECTS, VehicleContext
from thruster_env.auv.forces import Constants
from thruster_env.auv.plant import Plant
from thruster_env.auv.task import Task
from thruster_env.core.checks import covariance_root
from thruster_env.core.compiled import inlined
from thruster_env.core.memory import FRONT, KEY_0, KEY_1, STEP
from thruster_env.core.sources import written_out
from thruster_env.core.streams import normal_block
from thruster_env.effects.effects import Effect, encoded

# Gaussian noise on rows of a plant's memory, for a plant of any size.


BLOCK = 4  # normals of one draw


@cache
def noise_adder(size: int, first: int, root: int, stream: int) -> Callable:
    """Return `add(memory, b, numbers)`: add w ~ N(0, L L') to rows first ... first + size - 1 of every copy.

    The draws are those of `thruster_env.model.simulate` with the same keys. For initial states the row STEP must
    be 0.

    Args:
        size: number of rows.
        first: the first of them.
        root: the offset of the lower triangular L (size, size) in numbers, by rows.
        stream: the purpose of the noise, from `thruster_env.core.streams`.
    """
    of_copy = "memory[b, KEY_0, j], memory[b, KEY_1, j]"
    lines = ["for j in range(memory.shape[2]):"]
    for block in range(-(-size // BLOCK)):
        draws = ", ".join(f"w{BLOCK * block + i}" for i in range(BLOCK))
        lines.append(f"    {draws} = normal_block({block}, memory[b, STEP, j], {stream}, {of_copy})")
    for i in range(size):
        terms = " + ".join(f"numbers[{root + i * size + k}] * w{k}" for k in range(i + 1))
        lines.append(f"    memory[b, {first + i}, j] += {terms}")
    names: dict[str, Any] = {"normal_block": normal_block, "KEY_0": KEY_0, "KEY_1": KEY_1, "STEP": STEP}
    return written_out("add", "memory, b, numbers", *lines, "None", **names)


@inlined
def add_noise(memory, b, numbers, size, first, root, stream, scratch):
    """Add w ~ N(0, L L') to rows of every copy, as `noise_adder` does, for a number of rows known at run time.

    Zeros in L cost nothing. The draws are written into the rows from `scratch` on, `size` rounded up to a multiple
    of BLOCK.
    """
    for block in range((size + BLOCK - 1) // BLOCK):
        at = scratch + BLOCK * block
        for j in range(memory.shape[2]):
            w = normal_block(block, memory[b, STEP, j], stream, memory[b, KEY_0, j], memory[b, KEY_1, j])
            memory[b, at, j], memory[b, at + 1, j], memory[b, at + 2, j], memory[b, at + 3, j] = w
    for i in range(size):
        for k in range(i + 1):
            factor = numbers[root + i * size + k]
            if factor != 0.0:
                for j in range(memory.shape[2]):
                    memory[b, first + i, j] += factor * memory[b, scratch + k, j]


# Where things lie: rows of the memory of many vehicles, and places in the row of numbers of compiled code.


N = len(STATES)
U, V, W, P, Q, R, PHI, THETA, PSI, X, Y, Z = range(N)  # places in a state

# Behind the rows that all plants have in front, those that every step reports: the state, ...
STATE = len(FRONT)
CURRENT = STATE + N  # north, east, down [m/s]
INPUTS = CURRENT + 3  # X_prop, K_prop, delta_s, delta_r that act
TRUE_ERRORS = INPUTS + 4  # cross-track and vertical [m], which the reward is made of
PATH_DEPTH = TRUE_ERRORS + 2  # abreast of where the vehicle takes itself to be, in the next step [m]
ERRORS = PATH_DEPTH + 1  # by the vehicle's own reckoning: cross-track, vertical, course (sin, cos), speed
RECKONED = ERRORS + 5  # north, east, down, yaw by its own reckoning
PIECE = RECKONED + 4  # of the path that the true position has got to
OFFSET = PIECE + 1  # of the path's depth in the next step [m]
READINGS = OFFSET + 1  # a row for each channel, ...
VALID = READINGS + MAX_CHANNELS  # ... and whether it is valid
REPORTED = VALID + MAX_CHANNELS  # where they end
# ... and those that it keeps to itself. Rows of disturbances follow.
COMMAND = REPORTED  # as the action has them
RECKONED_PIECE = COMMAND + 4
GROUND_SPEED = RECKONED_PIECE + 1  # north, east, down by its own reckoning in the last step [m/s]
SCRATCH = GROUND_SPEED + 3  # draws of noise
FIXED_ROWS = SCRATCH + -(-max(N, MAX_CHANNELS) // BLOCK) * BLOCK

CONSTANT_COUNT = len(Constants._fields)

# Places in the row of numbers; the constants of the equations of motion come first.
SUBSTEPS, SAMPLE_TIME, INPUT_COUNT, MAX_THRUST, MAX_TORQUE, MAX_PLANE = range(CONSTANT_COUNT, CONSTANT_COUNT + 6)
TORQUE_RATIO, PROPELLER_DECAY, PLANE_DECAY = range(MAX_PLANE + 1, MAX_PLANE + 4)
MEAN = PLANE_DECAY + 1
PRIOR_ROOT = MEAN + N  # (12, 12) by rows
Q_ROOT = PRIOR_ROOT + N * N
CHANNEL_COUNT = Q_ROOT + N * N
CHANNEL_CODES = CHANNEL_COUNT + 1
R_ROOT = CHANNEL_CODES + MAX_CHANNELS  # (m, m) by rows
MEASURED_IN = R_ROOT + MAX_CHANNELS * MAX_CHANNELS  # the row of each state's channel, 0 for none
WEIGHTS = MEASURED_IN + N  # cross-track, vertical, speed, planes
SPEED = WEIGHTS + 4  # to keep [m/s]
STEP_SIZE, HOLD_STEPS = SPEED + 1, SPEED + 2  # of the depth [m], and for so many steps
STEEPEST_PITCH = HOLD_STEPS + 1  # pitch [rad] at which an episode ends
SECTIONS = STEEPEST_PITCH + 1  # number of effects on current and sensors
FIRST_EFFECT = SECTIONS + 2  # the place where they begin
PIECES = FIRST_EFFECT + 1  # of the path: their number, then each
FIRST_PIECE = PIECES + 1


REGISTRIES = (CURRENT_SIGNALS, VEHICLE_SENSOR_EFFECTS)  # in the order of a step
STEEPEST = math.radians(80.0)  # near a right angle Euler angles end
_SPACING = 64  # effects of each list have numbers of their own, whatever the other lists hold


def known_effects() -> tuple[tuple[type[Effect], ...], ...]:
    """Tuples of effects, one for each registry, that compiled code supports."""
    return tuple(tuple(registry.effects.values()) for registry in REGISTRIES)


def encode(plant: Plant, task: Task) -> tuple[np.ndarray, int]:
    """Numbers of a plant and a task, and how many rows beyond the fixed ones a copy's memory needs."""
    numbers = np.zeros(FIRST_PIECE)
    numbers[:CONSTANT_COUNT] = plant.constants
    numbers[SUBSTEPS] = plant.substeps
    numbers[SAMPLE_TIME] = plant.dt
    numbers[INPUT_COUNT] = len(plant.inputs)
    numbers[MAX_THRUST] = plant.max_thrust
    numbers[MAX_TORQUE] = plant.max_torque
    numbers[MAX_PLANE] = plant.max_plane
    numbers[TORQUE_RATIO] = plant.propeller_torque or 0.0
    numbers[PROPELLER_DECAY] = decay(plant.dt, plant.propeller_lag)
    numbers[PLANE_DECAY] = decay(plant.dt, plant.plane_lag)
    numbers[MEAN : MEAN + N] = plant.initial_mean
    m = len(plant.channels)
    roots = {
        PRIOR_ROOT: plant.initial_cov,
        Q_ROOT: plant.process_noise_cov,
        R_ROOT: plant.measurement_noise_cov,
    }
    for offset, cov in roots.items():
        numbers[offset : offset + cov.size] = covariance_root(cov).ravel()
    numbers[CHANNEL_COUNT] = m
    numbers[CHANNEL_CODES : CHANNEL_CODES + m] = [CHANNELS[channel].code for channel in plant.channels]
    for i, channel in enumerate(plant.channels):
        if MEASURED[channel] == channel:
            numbers[MEASURED_IN + SYMBOLS.index(channel)] = READINGS + i
    numbers[WEIGHTS : WEIGHTS + 4] = task.weights
    numbers[SPEED] = task.speed
    numbers[STEP_SIZE] = task.step_size
    numbers[HOLD_STEPS] = max(1.0, round(task.hold_time / plant.dt))
    numbers[STEEPEST_PITCH] = STEEPEST
    program, rows = _program(plant, numbers)
    numbers[PIECES] = len(task.path.lengths)
    numbers[FIRST_EFFECT] = FIRST_PIECE + task.path.numbers.size
    return np.concatenate([numbers, task.path.numbers, program]), rows


def decay(dt: float, time_constant: float) -> float:
    """The remaining fraction of the distance to a held command after a step: exp(-dt/T), 0 for T = 0."""
    return math.exp(-dt / time_constant) if time_constant > 0.0 else 0.0


def _program(plant: Plant, numbers: np.ndarray) -> tuple[list[float], int]:
    context = VehicleContext(plant.dt, VALID - READINGS, STATE + Z)
    chains = [(0, plant.current.get(name, ()), CURRENT + i) for i, name in enumerate(DIRECTIONS)]
    chains += [(1, effects, READINGS + i) for i, effects in enumerate(plant.sensors.values())]
    instruments = list(plant.instruments.values())  # what one of them measures is lost together
    first = [
        *range(len(DIRECTIONS)),
        *(len(DIRECTIONS) + instruments.index(instrument) for instrument in instruments),
    ]
    known = known_effects()
    program: list[float] = []
    rows = 0
    for index, (section, effects, target) in enumerate(chains):
        number, with_first = index * _SPACING, first[index] * _SPACING
        code, row_count = encoded(effects, known[section], target, FIXED_ROWS + rows, number, context, with_first)
        numbers[SECTIONS + section] += len(effects)
        program += code
        rows += row_count
    return program, rows
