"""The noisy thruster, any number of copies advanced one sample time by one compiled function.

    x_{k+1} = F(x_k, u_k) + w_k,  w ~ N(0, Q);      z_{k+1} = h(x_{k+1}) + v_{k+1},  v ~ N(0, R)

F integrates the equations of motion over one sample time; h are the channels. A single env is one copy, so the
same seed gives the same numbers on every path. One step: amplifier, flow, motion, process noise, measurement,
sensor effects, next reference, reward.

The equations of motion are those of `dynamics`; here they meet the memory. Everything works on `memory[b]`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from thruster_env.core.checks import covariance_root
from thruster_env.core.compiled import CompiledOrPython, compiled, function_fingerprint, inlined, is_interpreting
from thruster_env.core.matrices import zero_order_hold
from thruster_env.core.memory import (
    FIRST_REPORTED,
    FRONT,
    KEY_0,
    KEY_1,
    REWARD,
    STEP,
    TERMINATED,
    TIME,
    set_row,
)
from thruster_env.core.sources import vector_reader, written_out
from thruster_env.core.streams import INITIAL, MEASUREMENT, PROCESS, normal_block
from thruster_env.core.threads import in_parts
from thruster_env.effects.effects import SPACING, Effect, chain_of, encoded_chains
from thruster_env.effects.sensors import SENSOR_EFFECTS
from thruster_env.env.copies import Channel, PlantCopies, reader_of
from thruster_env.env.record import check_finite, record
from thruster_env.thruster.analysis import LinearModel
from thruster_env.thruster.channels import CHANNELS, MAX_CHANNELS, thrust
from thruster_env.thruster.dynamics import Constants, substep, thrust_and_torque
from thruster_env.thruster.effects import (
    AMPLIFIER_EFFECTS,
    FLOW_SIGNALS,
    REFERENCE_SIGNALS,
    Constant,
    ThrusterContext,
    drawn_parameters,
)
from thruster_env.thruster.parameters import derive_constants
from thruster_env.thruster.plant import Plant
from thruster_env.thruster.task import Task, state_limits, step_cost, thrust_scale

# Where things lie: rows of the memory of many thrusters, and offsets in the row of numbers of compiled code.

# Behind the rows that all plants have in front, those that every step reports, ...
OMEGA, FLOW, THRUST, AMBIENT, REFERENCE, NEXT_REFERENCE = range(len(FRONT), len(FRONT) + 6)
READINGS = NEXT_REFERENCE + 1  # a row for each channel, ...
VALID = READINGS + MAX_CHANNELS  # ... and whether it is valid
REPORTED = VALID + MAX_CHANNELS  # where they end
# ... and those that it keeps to itself. Rows of disturbances, then of drawn constants, follow.
COMMAND, LAST_COMMAND, VOLTAGE = range(REPORTED, REPORTED + 3)
FIXED_ROWS = REPORTED + 3

CONSTANT_COUNT = len(Constants._fields)

# Places in the row of numbers; the constants of the equations of motion come first.
SUBSTEPS, TOP_VOLTAGE, SAMPLE_TIME, CONSTANT_ROWS, LINEAR = range(CONSTANT_COUNT, CONSTANT_COUNT + 5)
Q_ROOT = LINEAR + 1  # lower triangle of 2 x 2, by rows
PRIOR_MEAN, PRIOR_ROOT = Q_ROOT + 3, Q_ROOT + 5
CHANNEL_COUNT = PRIOR_ROOT + 3
CHANNEL_CODES = CHANNEL_COUNT + 1
R_ROOT = CHANNEL_CODES + MAX_CHANNELS  # 4 x 4 by rows
LINEAR_MODEL = R_ROOT + MAX_CHANNELS * MAX_CHANNELS  # A_d (2, 2), B_d (2, 2), C (2,) by rows
REWARD_WEIGHTS = LINEAR_MODEL + 10  # tracking, energy, voltage rate
THRUST_SCALE = REWARD_WEIGHTS + 3
LIMITS = THRUST_SCALE + 1  # of |omega_m| and |U_a|
SECTIONS = LIMITS + 2  # number of effects on amplifier, flow, sensors and reference
FIRST_EFFECT = SECTIONS + 4


REGISTRIES = (AMPLIFIER_EFFECTS, FLOW_SIGNALS, SENSOR_EFFECTS, REFERENCE_SIGNALS)  # in the order of a step


def is_plain(plant: Plant, task: Task) -> bool:
    """Whether nothing disturbs the thrust measurement of a nominal thruster and the reference is constant.

    That is the frequent case, for which compiled code is smaller.
    """
    disturbed = plant.amplifier or plant.flow or plant.uncertainty or any(plant.sensors.values())
    other = plant.linear is not None or plant.channels != ("thrust",)
    return not disturbed and not other and {type(signal) for signal in task.reference} <= {Constant}


def known_effects(plant: Plant, task: Task) -> tuple[tuple[type[Effect], ...], ...]:
    """Effects, a tuple for each registry, that compiled code has to know: all, or of a plain plant hardly any."""
    if is_plain(plant, task):
        return (), (), (), (Constant,)
    return tuple(tuple(registry.effects.values()) for registry in REGISTRIES)


def encode(plant: Plant, task: Task) -> tuple[np.ndarray, int]:
    """Numbers of a plant and a task, the form that compiled steps read, and the rows of a copy's memory."""
    p = plant.parameters
    scale = thrust_scale(plant)
    context = ThrusterContext(plant.dt, MAX_CHANNELS, scale, p.motor_damping / p.voltage_gain, OMEGA)
    numbers = np.zeros(FIRST_EFFECT)
    numbers[:CONSTANT_COUNT] = plant.constants
    numbers[SUBSTEPS] = plant.substeps
    numbers[TOP_VOLTAGE] = plant.max_voltage
    numbers[SAMPLE_TIME] = plant.dt
    lower = np.tril_indices(2)
    numbers[Q_ROOT : Q_ROOT + 3] = covariance_root(plant.process_noise_cov)[lower]
    numbers[PRIOR_MEAN : PRIOR_MEAN + 2] = plant.initial_mean
    numbers[PRIOR_ROOT : PRIOR_ROOT + 3] = covariance_root(plant.initial_cov)[lower]
    m = len(plant.channels)
    numbers[CHANNEL_COUNT] = m
    numbers[CHANNEL_CODES : CHANNEL_CODES + m] = [CHANNELS[channel].code for channel in plant.channels]
    r_root = np.zeros((MAX_CHANNELS, MAX_CHANNELS))
    r_root[:m, :m] = covariance_root(plant.measurement_noise_cov)
    numbers[R_ROOT : R_ROOT + r_root.size] = r_root.ravel()
    if plant.linear is not None:
        numbers[LINEAR] = 1.0
        numbers[LINEAR_MODEL : LINEAR_MODEL + 10] = _discrete(plant.linear, plant.dt)
    numbers[REWARD_WEIGHTS : REWARD_WEIGHTS + 3] = task.weights
    numbers[THRUST_SCALE] = scale
    numbers[LIMITS : LIMITS + 2] = state_limits(plant)
    program, numbers[SECTIONS : SECTIONS + 4], rows = _program(plant, task, context)
    numbers[CONSTANT_ROWS] = FIXED_ROWS + rows if plant.uncertainty else 0.0
    return np.concatenate([numbers, program]), FIXED_ROWS + rows + (CONSTANT_COUNT if plant.uncertainty else 0)


def _discrete(linear: LinearModel, dt: float) -> np.ndarray:
    a_d, b_d = zero_order_hold(linear.a, linear.b, dt)
    return np.concatenate([a_d.ravel(), b_d.ravel(), linear.c.ravel()])


def _program(plant: Plant, task: Task, context: ThrusterContext) -> tuple[list[float], list[int], int]:
    chains: list[tuple] = [(0, plant.amplifier, VOLTAGE), (1, plant.flow, AMBIENT)]
    chains += [(2, effects, READINGS + i) for i, effects in enumerate(plant.sensors.values())]
    numbered = [(*chain, index * SPACING, None) for index, chain in enumerate(chains)]
    # The reference draws from a stream of its own, so it begins with number 0 whatever disturbs the plant.
    numbered.append((3, task.reference, NEXT_REFERENCE, 0, None))
    return encoded_chains(numbered, known_effects(plant, task), FIXED_ROWS, context)


# How a block of copies moves in one sample time: amplifier's input, state, noise and thrust.


read_constants = vector_reader(CONSTANT_COUNT)
drawn_constants = written_out(
    "drawn_constants",
    "memory, b, first, j",
    f"Constants({', '.join(f'memory[b, first + {i}, j]' for i in range(CONSTANT_COUNT))})",
    Constants=Constants,
)


@inlined
def constants_of_copy(memory, b, drawn, j, numbers):
    """Constants of copy j: those drawn for it, from row `drawn` on, the nominal ones where that is 0."""
    if drawn > 0:
        return drawn_constants(memory, b, drawn, j)
    return Constants(*read_constants(numbers))


@inlined
def draw_initial_state(memory, b, numbers):
    """Draw the initial state of every copy from its key, and forget the last episode."""
    mean_0, mean_1 = numbers[PRIOR_MEAN], numbers[PRIOR_MEAN + 1]
    root_00, root_10, root_11 = numbers[PRIOR_ROOT], numbers[PRIOR_ROOT + 1], numbers[PRIOR_ROOT + 2]
    for j in range(memory.shape[2]):
        w0, w1, _, _ = normal_block(0, 0, INITIAL, memory[b, KEY_0, j], memory[b, KEY_1, j])
        memory[b, OMEGA, j] = mean_0 + root_00 * w0
        memory[b, FLOW, j] = mean_1 + root_10 * w0 + root_11 * w1
        memory[b, COMMAND, j] = 0.0
        memory[b, REWARD, j] = 0.0
        memory[b, NEXT_REFERENCE, j] = 0.0


@inlined
def clip_command(memory, b, numbers):
    """Clip the commanded voltage to the action space, and hand it to the amplifier."""
    top = numbers[TOP_VOLTAGE]
    for j in range(memory.shape[2]):
        voltage = min(max(memory[b, COMMAND, j], -top), top)
        memory[b, COMMAND, j] = voltage
        memory[b, VOLTAGE, j] = voltage


@inlined
def move_thruster(memory, b, numbers):
    """Integrate the equations of motion over one sample time."""
    c = Constants(*read_constants(numbers))
    for _ in range(int(numbers[SUBSTEPS])):
        for j in range(memory.shape[2]):
            u = memory[b, VOLTAGE, j], memory[b, AMBIENT, j]
            omega, flow = substep((memory[b, OMEGA, j], memory[b, FLOW, j]), u, c)
            memory[b, OMEGA, j] = omega
            memory[b, FLOW, j] = flow


@inlined
def find_thrust(memory, b, numbers):
    """Thrust of every copy."""
    c = Constants(*read_constants(numbers))
    for j in range(memory.shape[2]):
        memory[b, THRUST, j], _ = thrust_and_torque((memory[b, OMEGA, j], memory[b, FLOW, j]), c)


@inlined
def move_any(memory, b, numbers):
    """The same for every kind of plant: with parameters drawn for each copy, and for a linear system."""
    if numbers[LINEAR] > 0.0:
        at = LINEAR_MODEL
        for j in range(memory.shape[2]):
            omega, flow = memory[b, OMEGA, j], memory[b, FLOW, j]
            voltage, ambient = memory[b, VOLTAGE, j], memory[b, AMBIENT, j]
            driven_0 = numbers[at + 4] * voltage + numbers[at + 5] * ambient
            driven_1 = numbers[at + 6] * voltage + numbers[at + 7] * ambient
            memory[b, OMEGA, j] = numbers[at] * omega + numbers[at + 1] * flow + driven_0
            memory[b, FLOW, j] = numbers[at + 2] * omega + numbers[at + 3] * flow + driven_1
    elif numbers[CONSTANT_ROWS] > 0.0:
        first = int(numbers[CONSTANT_ROWS])
        for _ in range(int(numbers[SUBSTEPS])):
            for j in range(memory.shape[2]):
                c = drawn_constants(memory, b, first, j)
                u = memory[b, VOLTAGE, j], memory[b, AMBIENT, j]
                omega, flow = substep((memory[b, OMEGA, j], memory[b, FLOW, j]), u, c)
                memory[b, OMEGA, j] = omega
                memory[b, FLOW, j] = flow
    else:
        move_thruster(memory, b, numbers)


@inlined
def find_any_thrust(memory, b, numbers):
    """The same for every kind of plant."""
    if numbers[LINEAR] > 0.0:
        by_speed, by_flow = numbers[LINEAR_MODEL + 8], numbers[LINEAR_MODEL + 9]
        for j in range(memory.shape[2]):
            memory[b, THRUST, j] = by_speed * memory[b, OMEGA, j] + by_flow * memory[b, FLOW, j]
    elif numbers[CONSTANT_ROWS] > 0.0:
        first = int(numbers[CONSTANT_ROWS])
        for j in range(memory.shape[2]):
            c = drawn_constants(memory, b, first, j)
            memory[b, THRUST, j], _ = thrust_and_torque((memory[b, OMEGA, j], memory[b, FLOW, j]), c)
    else:
        find_thrust(memory, b, numbers)


@inlined
def add_process_noise(memory, b, numbers):
    """Add w ~ N(0, Q) to the state."""
    root_00, root_10, root_11 = numbers[Q_ROOT], numbers[Q_ROOT + 1], numbers[Q_ROOT + 2]
    for j in range(memory.shape[2]):
        w0, w1, _, _ = normal_block(0, memory[b, STEP, j], PROCESS, memory[b, KEY_0, j], memory[b, KEY_1, j])
        memory[b, OMEGA, j] += root_00 * w0
        memory[b, FLOW, j] += root_10 * w0 + root_11 * w1


LARGEST_ERROR = 1e6  # of thrust over T_max: a reward stays finite when a state does not


@inlined
def _measure_thrust(memory, b, numbers):
    sigma = numbers[R_ROOT]
    for j in range(memory.shape[2]):
        v, _, _, _ = normal_block(0, memory[b, STEP, j], MEASUREMENT, memory[b, KEY_0, j], memory[b, KEY_1, j])
        memory[b, READINGS, j] = thrust((), (memory[b, THRUST, j],), (), ()) + sigma * v
        memory[b, VALID, j] = 1.0


def _of_copy(read: Callable) -> Callable:
    """Read one channel of copy j; where `drawn` is not 0, its own constants begin in that row."""

    @inlined
    def read_copy(memory, b, j, drawn, numbers):
        x, y = (memory[b, OMEGA, j], memory[b, FLOW, j]), (memory[b, THRUST, j],)
        c = constants_of_copy(memory, b, drawn, j, numbers)
        return read(x, y, (memory[b, VOLTAGE, j],), c)

    return read_copy


@cache
def _measure_any(channels: tuple[Channel, ...]) -> Callable:
    """`measure(memory, b, numbers)` for a plant that has some of these channels."""
    read = reader_of(channels, _of_copy, "memory, b, j, drawn, numbers")

    @inlined
    def measure(memory, b, numbers):
        count, drawn = int(numbers[CHANNEL_COUNT]), int(numbers[CONSTANT_ROWS])
        for i in range(count):
            code = numbers[CHANNEL_CODES + i]
            for j in range(memory.shape[2]):
                memory[b, READINGS + i, j] = read(code, memory, b, j, drawn, numbers)
                memory[b, VALID + i, j] = 1.0
        for j in range(memory.shape[2]):
            v = normal_block(0, memory[b, STEP, j], MEASUREMENT, memory[b, KEY_0, j], memory[b, KEY_1, j])
            for i in range(count):
                at = R_ROOT + i * MAX_CHANNELS
                noise = (
                    numbers[at] * v[0] + numbers[at + 1] * v[1] + numbers[at + 2] * v[2] + numbers[at + 3] * v[3]
                )
                memory[b, READINGS + i, j] += noise

    return measure


@inlined
def _reward(memory, b, numbers):
    tracking, energy, rate = numbers[REWARD_WEIGHTS], numbers[REWARD_WEIGHTS + 1], numbers[REWARD_WEIGHTS + 2]
    per_thrust, per_volt = 1.0 / numbers[THRUST_SCALE], 1.0 / numbers[TOP_VOLTAGE]
    for j in range(memory.shape[2]):
        error = (memory[b, THRUST, j] - memory[b, REFERENCE, j]) * per_thrust
        error = error if abs(error) < LARGEST_ERROR else LARGEST_ERROR  # NaN, too, as the episode ends
        voltage = memory[b, COMMAND, j] * per_volt
        change = voltage - memory[b, LAST_COMMAND, j] * per_volt
        memory[b, REWARD, j] = -step_cost(error, voltage, change, tracking, energy, rate)


@inlined
def _tell_time_and_end(memory, b, numbers):
    top_omega, top_flow = numbers[LIMITS], numbers[LIMITS + 1]
    for j in range(memory.shape[2]):
        memory[b, TIME, j] = memory[b, STEP, j] * numbers[SAMPLE_TIME]
        within_limits = abs(memory[b, OMEGA, j]) < top_omega and abs(memory[b, FLOW, j]) < top_flow
        memory[b, TERMINATED, j] = 0.0 if within_limits else 1.0
        memory[b, LAST_COMMAND, j] = memory[b, COMMAND, j]


def advance(known_effects, plain: bool) -> Callable:
    """Compiled `step(first, last, memory, numbers, out, begin)` on blocks first ... last - 1 of a memory.

    With `begin` it starts an episode of every copy from its key (rows KEY_0, KEY_1), and takes the first
    measurement; else it applies the voltages in row COMMAND for one sample time. The reported rows are copied to
    out (REPORTED, blocks, width).

    Args:
        known_effects: a tuple of effects for each registry, as `known_effects` gives them.
        plain: know only a nominal thruster whose thrust is measured; compiles and runs faster.
    """
    return _build(compiled, known_effects, _known_channels(plain), plain, is_interpreting())


def advance_in_parts(known_effects, plain: bool) -> CompiledOrPython:
    """The same for `threads.WorkerThreads.run`."""
    return _build(in_parts, known_effects, _known_channels(plain), plain, is_interpreting())


def _known_channels(plain: bool) -> tuple[Channel, ...]:
    """Channels that compiled code has to know, by their codes."""
    return () if plain else tuple(sorted(CHANNELS.values(), key=lambda channel: channel.code))


@cache
def _build(maker: Callable, known_effects, channels, plain: bool, interpreting: bool) -> Any:
    amplify, stream, sense, refer = (
        chain_of(effects, SECTIONS + section) for section, effects in enumerate(known_effects)
    )
    move, push = (move_thruster, find_thrust) if plain else (move_any, find_any_thrust)
    measure = _measure_thrust if plain else _measure_any(channels)
    reported = READINGS + 1 if plain else REPORTED  # rows beyond are of channels that there are not
    acts = [effect.act for effects in known_effects for effect in effects]
    fingerprint = function_fingerprint(*acts, measure, within=__name__)

    def step(first, last, memory, numbers, out, begin):
        fingerprint  # noqa: B018 - part of the cache's key
        width = memory.shape[2]
        for b in range(first, last):
            if begin:
                draw_initial_state(memory, b, numbers)
            clip_command(memory, b, numbers)
            for j in range(width):
                memory[b, STEP, j] = 0.0 if begin else memory[b, STEP, j] + 1.0
                memory[b, AMBIENT, j] = numbers[CONSTANT_COUNT - 2]
            at = amplify(memory, b, numbers, FIRST_EFFECT, begin)
            at = stream(memory, b, numbers, at, begin)
            if not begin:
                move(memory, b, numbers)
                add_process_noise(memory, b, numbers)
            push(memory, b, numbers)
            measure(memory, b, numbers)
            at = sense(memory, b, numbers, at, begin)
            if begin:  # r_0 first; then r_1, as in every step
                for j in range(width):
                    memory[b, STEP, j] = -1.0
                refer(memory, b, numbers, at, True)
                for j in range(width):
                    memory[b, STEP, j] = 0.0
            for j in range(width):
                memory[b, REFERENCE, j] = memory[b, NEXT_REFERENCE, j]
                memory[b, NEXT_REFERENCE, j] = 0.0
            refer(memory, b, numbers, at, False)
            if not begin:
                _reward(memory, b, numbers)
            _tell_time_and_end(memory, b, numbers)
            for i in range(FIRST_REPORTED, reported):
                for j in range(width):
                    out[i, b, j] = memory[b, i, j]

    return maker(step)


# Many copies of a thruster, stepped in place by envs and by `simulate`.


class Copies(PlantCopies):
    """N copies of a thruster with a task; rows of their reports are above."""

    commands, reported = (COMMAND,), REPORTED

    def encode(self, plant: Plant) -> tuple[np.ndarray, int]:
        """See `encode`."""
        return encode(plant, self.task)

    def machine_code(self) -> tuple[Callable, CompiledOrPython]:
        """The compiled step of this plant and task."""
        effects = known_effects(self.plant, self.task), is_plain(self.plant, self.task)
        return advance(*effects), advance_in_parts(*effects)

    def prepare(self, memory: np.ndarray, keys: np.ndarray) -> None:
        """Draw uncertain parameters for episodes with keys (count, 2)."""
        plant = self.plant
        if not plant.uncertainty:
            return
        parameters = drawn_parameters(plant.parameters, plant.uncertainty, keys)
        constants = derive_constants(parameters, plant.ambient_velocity, plant.dt / plant.substeps)
        first = int(self.numbers[CONSTANT_ROWS])
        for i, values in enumerate(constants):
            set_row(memory, first + i, np.broadcast_to(values, len(keys)))


# Trajectories of a plant, without an env around it.


class Simulation(NamedTuple):
    """Trajectories of a batch of B plants over K steps."""

    states: np.ndarray  # (B, K + 1, 2)
    thrusts: np.ndarray  # (B, K + 1) [N]
    measurements: np.ndarray  # (B, K + 1, m)
    valid: np.ndarray  # (B, K + 1, m), false where a measurement is missing and the last one repeated

    def checked(self, what: str = "a simulation") -> Simulation:
        """The same; ValueError that names the first step at which a number is not finite."""
        check_finite(what, self.states, self.thrusts[..., None], self.measurements)
        return self


def simulate(plant: Plant, keys: np.ndarray, voltages: np.ndarray) -> Simulation:
    """Run a plant from its initial state for every key (B, 2) under voltages (B, K) [V].

    The same key and voltages give the same numbers as an env that is stepped through Gymnasium.

    Raises:
        ValueError: if shapes do not fit or a number is not finite.
    """
    reports = record(lambda count: Copies(plant, Task(), count), keys, voltages, "voltages", 1)
    m = len(plant.channels)
    readings = reports[..., READINGS : READINGS + m]
    valid = reports[..., VALID : VALID + m] > 0 if plant.dropping_channels else np.ones(readings.shape, dtype=bool)
    return Simulation(reports[..., OMEGA : FLOW + 1], reports[..., THRUST], readings, valid)
