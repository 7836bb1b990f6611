"""Where vehicles are on their path: truly, for the reward, and by their own reckoning, for the observation.

A vehicle computes its position by dead reckoning from its known start: measured velocities over ground are turned
into the earth's axes by the measured attitude and summed, and depth and yaw are those measured. Quantities without
a sensor are taken as zero, and yaw follows from the measured rates. Position fixes, acoustic or from satellites,
are not used: weighing them is a filter's task.
"""

from __future__ import annotations

import numpy as np

from thruster_env.auv.dynamics import angle_rates, attitude_of, in_earth_axes
from thruster_env.auv.engine.encoding import (
    COMMAND,
    ERRORS,
    FIRST_PIECE,
    GROUND_SPEED,
    HOLD_STEPS,
    INPUT_COUNT,
    MAX_PLANE,
    MEAN,
    MEASURED_IN,
    OFFSET,
    PATH_DEPTH,
    PHI,
    PIECE,
    PIECES,
    PSI,
    RECKONED,
    RECKONED_PIECE,
    SAMPLE_TIME,
    SPEED,
    STATE,
    STEP_SIZE,
    THETA,
    TRUE_ERRORS,
    WEIGHTS,
    P,
    Q,
    R,
    U,
    V,
    W,
    X,
    Y,
    Z,
)
from thruster_env.auv.paths import PIECE as LENGTH
from thruster_env.auv.task import step_cost
from thruster_env.core.compiled import inlined
from thruster_env.core.memory import KEY_0, KEY_1, REWARD, STEP
from thruster_env.core.streams import REFERENCE_SIGNAL, cosine_and_sine, uniform_block

LARGEST_ERROR = 1e6  # [m], [m/s]: a reward stays finite when a state does not


@inlined
def _measured(memory, b, j, numbers, i):
    """Copy j's measurement of state i; 0 if no channel measures it."""
    row = int(numbers[MEASURED_IN + i])
    return memory[b, row, j] if row > 0 else 0.0


@inlined
def reckon(memory, b, numbers, begin):
    """Each copy's dead-reckoned position from its measurements; speeds are averaged over the step."""
    half = 0.5 * numbers[SAMPLE_TIME]
    has_yaw, has_depth = numbers[MEASURED_IN + PSI] > 0.0, numbers[MEASURED_IN + Z] > 0.0
    for j in range(memory.shape[2]):
        attitude = attitude_of(_measured(memory, b, j, numbers, PHI), _measured(memory, b, j, numbers, THETA))
        rates = _measured(memory, b, j, numbers, P), _measured(memory, b, j, numbers, Q)
        turning = angle_rates(attitude, rates[0], rates[1], _measured(memory, b, j, numbers, R))[2]
        yaw = numbers[MEAN + PSI] if begin else memory[b, RECKONED + 3, j] + 2.0 * half * turning
        yaw = _measured(memory, b, j, numbers, PSI) if has_yaw else yaw
        velocity = _measured(memory, b, j, numbers, U), _measured(memory, b, j, numbers, V)
        north, east, down = in_earth_axes(
            attitude, yaw, velocity[0], velocity[1], _measured(memory, b, j, numbers, W)
        )
        if begin:
            memory[b, RECKONED, j] = numbers[MEAN + X]
            memory[b, RECKONED + 1, j] = numbers[MEAN + Y]
            memory[b, RECKONED + 2, j] = numbers[MEAN + Z]
        else:
            memory[b, RECKONED, j] += half * (memory[b, GROUND_SPEED, j] + north)
            memory[b, RECKONED + 1, j] += half * (memory[b, GROUND_SPEED + 1, j] + east)
            memory[b, RECKONED + 2, j] += half * (memory[b, GROUND_SPEED + 2, j] + down)
        if has_depth:
            memory[b, RECKONED + 2, j] = _measured(memory, b, j, numbers, Z)
        memory[b, RECKONED + 3, j] = yaw
        memory[b, GROUND_SPEED, j] = north
        memory[b, GROUND_SPEED + 1, j] = east
        memory[b, GROUND_SPEED + 2, j] = down


@inlined
def step_depth(memory, b, numbers, begin):
    """The depth to keep in the next step, less the path's: a step up or down at random every so often."""
    size, hold = numbers[STEP_SIZE], numbers[HOLD_STEPS]
    for j in range(memory.shape[2]):
        if begin:
            memory[b, OFFSET, j] = 0.0
        part = (memory[b, STEP, j] + 1.0) / hold
        if part == np.floor(part) and size > 0.0:
            u, _, _, _ = uniform_block(0, part, REFERENCE_SIGNAL, memory[b, KEY_0, j], memory[b, KEY_1, j])
            change = size if u < 0.5 else -size
            next_offset = memory[b, OFFSET, j] + change
            memory[b, OFFSET, j] += change if abs(next_offset) < 2.5 * size else -change


@inlined
def _piece(numbers, piece, x, y, z):
    """The piece of the path that a position has got to, from the one that it was at; as `paths.Path.piece`."""
    last = int(numbers[PIECES]) - 1
    at = FIRST_PIECE + LENGTH * piece
    while piece < last:
        along = (x - numbers[at]) * numbers[at + 3] + (y - numbers[at + 1]) * numbers[at + 4]
        if not along + (z - numbers[at + 2]) * numbers[at + 5] > numbers[at + 6]:
            break
        piece += 1
        at += LENGTH
    return piece


@inlined
def _off_path(numbers, piece, x, y, z):
    """Distance to starboard of a piece and below it, and the cosine and sine of its course."""
    at = FIRST_PIECE + LENGTH * piece
    ahead, aside, below = numbers[at + 3], numbers[at + 4], numbers[at + 5]
    x, y, z = x - numbers[at], y - numbers[at + 1], z - numbers[at + 2]
    along = x * ahead + y * aside + z * below
    per_level = 1.0 / (ahead * ahead + aside * aside) ** 0.5
    cosine, sine = ahead * per_level, aside * per_level
    return (y - along * aside) * cosine - (x - along * ahead) * sine, z - along * below, cosine, sine


@inlined
def find_true_errors(memory, b, numbers, begin):
    """Each copy's true distance from the path."""
    for j in range(memory.shape[2]):
        x, y, z = memory[b, STATE + X, j], memory[b, STATE + Y, j], memory[b, STATE + Z, j] - memory[b, OFFSET, j]
        piece = _piece(numbers, 0 if begin else int(memory[b, PIECE, j]), x, y, z)
        memory[b, PIECE, j] = piece
        memory[b, TRUE_ERRORS, j], memory[b, TRUE_ERRORS + 1, j], _, _ = _off_path(numbers, piece, x, y, z)


@inlined
def find_errors(memory, b, numbers, begin):
    """Each copy's errors of path and speed by dead reckoning, for the next step."""
    has_speed = numbers[MEASURED_IN + U] > 0.0
    for j in range(memory.shape[2]):
        x, y, z = memory[b, RECKONED, j], memory[b, RECKONED + 1, j], memory[b, RECKONED + 2, j]
        z = z - memory[b, OFFSET, j]
        piece = _piece(numbers, 0 if begin else int(memory[b, RECKONED_PIECE, j]), x, y, z)
        memory[b, RECKONED_PIECE, j] = piece
        memory[b, ERRORS, j], memory[b, ERRORS + 1, j], cosine, sine = _off_path(numbers, piece, x, y, z)
        memory[b, PATH_DEPTH, j] = memory[b, RECKONED + 2, j] - memory[b, ERRORS + 1, j]
        along, across = cosine_and_sine(memory[b, RECKONED + 3, j])
        memory[b, ERRORS + 2, j] = across * cosine - along * sine
        memory[b, ERRORS + 3, j] = along * cosine + across * sine
        memory[b, ERRORS + 4, j] = _measured(memory, b, j, numbers, U) - numbers[SPEED] if has_speed else 0.0


@inlined
def _finite(error):
    return error if abs(error) < LARGEST_ERROR else LARGEST_ERROR  # NaN, too, as the episode ends


@inlined
def find_reward(memory, b, numbers):
    """The reward of a step, from the errors after it and the commanded planes."""
    weights = numbers[WEIGHTS], numbers[WEIGHTS + 1], numbers[WEIGHTS + 2], numbers[WEIGHTS + 3]
    per_plane = 1.0 / numbers[MAX_PLANE] if numbers[MAX_PLANE] > 0.0 else 0.0
    stern = COMMAND + (2 if numbers[INPUT_COUNT] > 3.0 else 1)
    for j in range(memory.shape[2]):
        cross_track, vertical = _finite(memory[b, TRUE_ERRORS, j]), _finite(memory[b, TRUE_ERRORS + 1, j])
        speed = _finite(memory[b, STATE + U, j] - numbers[SPEED])
        planes = memory[b, stern, j] * per_plane, memory[b, stern + 1, j] * per_plane
        memory[b, REWARD, j] = -step_cost(cross_track, vertical, speed, planes[0], planes[1], weights)
