"""The noisy vehicle, any number of copies advanced one sample time by one compiled function.

    x_{k+1} = F(x_k, u_k) + w_k,  w ~ N(0, Q);      z_{k+1} = h(x_{k+1}) + v_{k+1},  v ~ N(0, R)

F integrates the equations of motion over one sample time, in the current; h are the channels. A single env is one
copy, so the same seed gives the same numbers on every path. One step: commands, current, motion, process noise,
measurement, sensor effects, reward, the vehicle's own reckoning.

The equations are those of `dynamics`; here they meet the memory. Everything works on `memory[b]`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np

from thruster_env.auv.dynamics import angle_rates, attitude_of, current_substep, in_earth_axes
from thruster_env.auv.forces import Constants
from thruster_env.auv.paths import PIECE as LENGTH
from thruster_env.auv.paths import Task, make_task, step_cost
from thruster_env.auv.plant import (
    CHANNELS,
    CURRENT_SIGNALS,
    DIRECTIONS,
    MAX_CHANNELS,
    MEASURED,
    STATES,
    SYMBOLS,
    VEHICLE_SENSOR_EFFECTS,
    Plant,
    VehicleContext,
)
from thruster_env.core.checks import covariance_root
from thruster_env.core.compiled import CompiledOrPython, inlined
from thruster_env.core.memory import FIRST_REPORTED, FRONT, KEY_0, KEY_1, REWARD, STEP, TERMINATED, TIME
from thruster_env.core.sources import tuple_of, written_out
from thruster_env.core.streams import (
    INITIAL,
    MEASUREMENT,
    PROCESS,
    REFERENCE_SIGNAL,
    cosine_and_sine,
    uniform_block,
)
from thruster_env.effects.effects import SPACING, Effect, chain_of, encoded_chains
from thruster_env.env.copies import BLOCK, Channel, PlantCopies, add_noise, machine_code_of, reader_of
from thruster_env.env.record import check_finite, record

# Where things lie: rows of the memory of many vehicles, and offsets in the row of numbers of compiled code.

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


def known_effects() -> tuple[tuple[type[Effect], ...], ...]:
    """Tuples of effects, one for each registry, that compiled code supports."""
    return tuple(tuple(registry.effects.values()) for registry in REGISTRIES)


def encode(plant: Plant, task: Task) -> tuple[np.ndarray, int]:
    """Numbers of a plant and a task, the form that compiled steps read, and the rows of a copy's memory."""
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
    program, numbers[SECTIONS : SECTIONS + 2], rows = _program(plant)
    numbers[PIECES] = len(task.path.lengths)
    numbers[FIRST_EFFECT] = FIRST_PIECE + task.path.numbers.size
    return np.concatenate([numbers, task.path.numbers, program]), FIXED_ROWS + rows


def decay(dt: float, time_constant: float) -> float:
    """The remaining fraction of the distance to a held command after a step: exp(-dt/T), 0 for T = 0."""
    return math.exp(-dt / time_constant) if time_constant > 0.0 else 0.0


def _program(plant: Plant) -> tuple[list[float], list[int], int]:
    context = VehicleContext(plant.dt, VALID - READINGS, STATE + Z)
    chains: list[tuple] = [
        (0, plant.current.get(name, ()), CURRENT + i, i * SPACING, i * SPACING)
        for i, name in enumerate(DIRECTIONS)
    ]
    instruments = list(plant.instruments.values())  # what one of them measures is lost together
    for i, effects in enumerate(plant.sensors.values()):
        first = instruments.index(instruments[i])
        numbers = ((len(DIRECTIONS) + index) * SPACING for index in (i, first))
        chains.append((1, effects, READINGS + i, *numbers))
    return encoded_chains(chains, known_effects(), FIXED_ROWS, context)


# How a block of vehicles moves in one sample time: commands, lags, equations of motion.


read_constants = written_out(
    "constants",
    "numbers",
    f"Constants({', '.join(f'numbers[{i}]' for i in range(CONSTANT_COUNT))})",
    Constants=Constants,
)
read_state = written_out("state", "memory, b, j", tuple_of(f"memory[b, {STATE + i}, j]" for i in range(N)))
write_state = written_out(
    "store", "memory, b, j, x", *(f"memory[b, {STATE + i}, j] = x[{i}]" for i in range(N)), "None"
)
read_inputs = written_out(
    "inputs",
    "memory, b, j",
    tuple_of(f"memory[b, {row}, j]" for row in (*range(INPUTS, INPUTS + 4), *range(CURRENT, CURRENT + 3))),
)


@inlined
def begin_at_mean(memory, b, numbers):
    """Put every copy at the mean of the initial state, with nothing commanded."""
    for i in range(N):
        for j in range(memory.shape[2]):
            memory[b, STATE + i, j] = numbers[MEAN + i]
    for i in range(4):
        for j in range(memory.shape[2]):
            memory[b, COMMAND + i, j] = 0.0
            memory[b, INPUTS + i, j] = 0.0


@inlined
def limited(value, limit):
    """Value within plus and minus a limit."""
    return min(max(value, -limit), limit)


@inlined
def take_commands(memory, b, numbers):
    """Clip the commands to the action space, and let the propeller and the planes follow them."""
    top, torque, plane, ratio = numbers[MAX_THRUST], numbers[MAX_TORQUE], numbers[MAX_PLANE], numbers[TORQUE_RATIO]
    of_propeller, of_planes = numbers[PROPELLER_DECAY], numbers[PLANE_DECAY]
    has_torque = numbers[INPUT_COUNT] > 3.0  # the torque is an input of its own
    stern = COMMAND + (2 if has_torque else 1)
    for j in range(memory.shape[2]):
        thrust = min(max(memory[b, COMMAND, j], 0.0), top)
        turning = limited(memory[b, COMMAND + 1, j], torque) if has_torque else ratio * thrust
        stern_plane, rudder = limited(memory[b, stern, j], plane), limited(memory[b, stern + 1, j], plane)
        memory[b, INPUTS, j] = thrust + of_propeller * (memory[b, INPUTS, j] - thrust)
        memory[b, INPUTS + 1, j] = turning + of_propeller * (memory[b, INPUTS + 1, j] - turning)
        memory[b, INPUTS + 2, j] = stern_plane + of_planes * (memory[b, INPUTS + 2, j] - stern_plane)
        memory[b, INPUTS + 3, j] = rudder + of_planes * (memory[b, INPUTS + 3, j] - rudder)
        memory[b, COMMAND, j], memory[b, stern, j], memory[b, stern + 1, j] = thrust, stern_plane, rudder


@inlined
def move(memory, b, numbers):
    """Integrate the equations of motion over one sample time, in the current."""
    c = read_constants(numbers)
    for _ in range(int(numbers[SUBSTEPS])):
        for j in range(memory.shape[2]):
            write_state(memory, b, j, current_substep(read_state(memory, b, j), read_inputs(memory, b, j), c))


# Where vehicles are on their path: truly, for the reward, and by their own reckoning, for the observation.
#
# A vehicle computes its position by dead reckoning from its known start: measured velocities over ground are
# turned into the earth's axes by the measured attitude and summed, and depth and yaw are those measured.
# Quantities without a sensor are taken as zero, and yaw follows from the measured rates. Position fixes, acoustic
# or from satellites, are not used: weighing them is a filter's task.


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


# The step, and its machine code.


LARGEST = 1e12  # of the sum of a state's magnitudes: beyond it, or where it is no number, an episode ends


def _of_copy(read: Callable) -> Callable:
    """Read one channel of copy j."""
    return inlined(lambda memory, b, j: read(read_state(memory, b, j), (), (), ()))


@inlined
def _tell_time_and_end(memory, b, numbers):
    steepest = numbers[STEEPEST_PITCH]
    for j in range(memory.shape[2]):
        memory[b, TIME, j] = memory[b, STEP, j] * numbers[SAMPLE_TIME]
        size = 0.0
        for i in range(N):
            size += abs(memory[b, STATE + i, j])
        within_limits = abs(memory[b, STATE + THETA, j]) < steepest and size < LARGEST
        memory[b, TERMINATED, j] = 0.0 if within_limits else 1.0


def machine_code() -> tuple[Callable, CompiledOrPython]:
    """The compiled `step(first, last, memory, numbers, out, begin)` of vehicles: `thruster_env.env.copies`."""
    return machine_code_of(
        _step(known_effects(), tuple(sorted(CHANNELS.values(), key=lambda channel: channel.code)))
    )


@cache
def _step(effects, channels: tuple[Channel, ...]) -> Callable:
    flow, sense = (chain_of(kinds, SECTIONS + section) for section, kinds in enumerate(effects))
    read = reader_of(channels, _of_copy, "memory, b, j")

    @inlined
    def measure(memory, b, numbers):
        count = int(numbers[CHANNEL_COUNT])
        for i in range(count):
            code = numbers[CHANNEL_CODES + i]
            for j in range(memory.shape[2]):
                memory[b, READINGS + i, j] = read(code, memory, b, j)
                memory[b, VALID + i, j] = 1.0
        add_noise(memory, b, numbers, count, READINGS, R_ROOT, MEASUREMENT, SCRATCH)

    def step(first, last, memory, numbers, out, begin):
        width = memory.shape[2]
        for b in range(first, last):
            for j in range(width):
                memory[b, STEP, j] = 0.0 if begin else memory[b, STEP, j] + 1.0
                for i in range(3):
                    memory[b, CURRENT + i, j] = 0.0
            at = flow(memory, b, numbers, int(numbers[FIRST_EFFECT]), begin)
            if begin:
                begin_at_mean(memory, b, numbers)
                add_noise(memory, b, numbers, N, STATE, PRIOR_ROOT, INITIAL, SCRATCH)
                step_depth(memory, b, numbers, True)  # before the first step there is none
            else:
                take_commands(memory, b, numbers)
                move(memory, b, numbers)
                add_noise(memory, b, numbers, N, STATE, Q_ROOT, PROCESS, SCRATCH)
            measure(memory, b, numbers)
            sense(memory, b, numbers, at, begin)
            find_true_errors(memory, b, numbers, begin)
            if begin:
                for j in range(width):
                    memory[b, REWARD, j] = 0.0
            else:
                find_reward(memory, b, numbers)
                step_depth(memory, b, numbers, False)
            reckon(memory, b, numbers, begin)
            find_errors(memory, b, numbers, begin)
            _tell_time_and_end(memory, b, numbers)
            for i in range(FIRST_REPORTED, REPORTED):
                for j in range(width):
                    out[i, b, j] = memory[b, i, j]

    return step


# Many copies of a vehicle at work in place: what envs step and what `simulate` records.


class Copies(PlantCopies):
    """N copies of a vehicle with a task; rows of their reports are in `thruster_env.auv.simulation`."""

    reported = REPORTED

    def __init__(self, plant: Plant, task: Task, count: int):
        """Allocate the memory of `count` copies; `begin` comes next."""
        self.commands = tuple(range(COMMAND, COMMAND + len(plant.inputs)))
        super().__init__(plant, task, count)

    def encode(self, plant: Plant) -> tuple[np.ndarray, int]:
        """See `encode`."""
        return encode(plant, self.task)

    def machine_code(self) -> tuple[Callable, CompiledOrPython]:
        """The compiled step, the same for every plant and task."""
        return machine_code()


# Whole trajectories of a plant, without an env around it.


class Simulation(NamedTuple):
    """Trajectories of a batch of B vehicles over K steps."""

    states: np.ndarray  # (B, K + 1, 12)
    measurements: np.ndarray  # (B, K + 1, m)
    valid: np.ndarray  # (B, K + 1, m), false where a measurement is missing and the last one repeated
    current: np.ndarray  # (B, K + 1, 3), to the north, to the east and down [m/s]

    def checked(self, what: str = "a simulation") -> Simulation:
        """The same; ValueError that names the first step at which a number is not finite."""
        check_finite(what, self.states, self.measurements)
        return self


def simulate(plant: Plant, keys: np.ndarray, inputs: np.ndarray) -> Simulation:
    """Run a plant from its initial state for every key (B, 2) under inputs (B, K, p).

    The same key and inputs give the same numbers as an env that is stepped through Gymnasium.

    Raises:
        ValueError: if shapes do not fit or a number is not finite.
    """
    m = len(plant.channels)
    reports = record(lambda count: Copies(plant, make_task(), count), keys, inputs, "inputs", len(plant.inputs))
    valid = reports[..., VALID : VALID + m] > 0.0
    parts = (reports[..., first : first + count] for first, count in ((STATE, N), (READINGS, m), (CURRENT, 3)))
    states, measurements, current = parts
    return Simulation(states, measurements, valid, current)
