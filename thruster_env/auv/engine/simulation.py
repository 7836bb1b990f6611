"""The noisy vehicle, any number of copies advanced one sample time by one compiled function.

    x_{k+1} = F(x_k, u_k) + w_k,  w ~ N(0, Q);      z_{k+1} = h(x_{k+1}) + v_{k+1},  v ~ N(0, R)

F integrates the equations of motion over one sample time, in the current; h are the channels. A single env is one
copy, so the same seed gives the same numbers on every path. One step: commands, current, motion, process noise,
measurement, sensor effects, reward, the vehicle's own reckoning.

The equations are those of `dynamics`; here they meet the memory. Everything works on `memory[b]`, see
`thruster_env.auv.engine.encoding`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from typing import NamedTuple

import numpy as np

from thruster_env.auv.channels import CHANNELS
from thruster_env.auv.dynamics import current_substep
from thruster_env.auv.engine.encoding import (
    CHANNEL_CODES,
    CHANNEL_COUNT,
    COMMAND,
    CONSTANT_COUNT,
    CURRENT,
    FIRST_EFFECT,
    FIXED_ROWS,
    INPUT_COUNT,
    INPUTS,
    MAX_PLANE,
    MAX_THRUST,
    MAX_TORQUE,
    MEAN,
    PLANE_DECAY,
    PRIOR_ROOT,
    PROPELLER_DECAY,
    Q_ROOT,
    R_ROOT,
    READINGS,
    REPORTED,
    SAMPLE_TIME,
    SCRATCH,
    SECTIONS,
    STATE,
    STEEPEST_PITCH,
    SUBSTEPS,
    THETA,
    TORQUE_RATIO,
    VALID,
    N,
    add_noise,
    encode,
    known_effects,
)
from thruster_env.auv.engine.guidance import find_errors, find_reward, find_true_errors, reckon, step_depth
from thruster_env.auv.forces import Constants
from thruster_env.auv.plant import Plant
from thruster_env.auv.plant import state as checked_state
from thruster_env.auv.task import Task, make_task
from thruster_env.core.checks import options as checked_options
from thruster_env.core.compiled import CompiledOrPython, inlined
from thruster_env.core.memory import FIRST_REPORTED, REWARD, STEP, TERMINATED, TIME
from thruster_env.core.sources import tuple_of, written_out
from thruster_env.core.streams import INITIAL, MEASUREMENT, PROCESS
from thruster_env.effects.effects import chain_of
from thruster_env.env.copies import Channel, PlantCopies, machine_code_of, reader_of
from thruster_env.env.record import check_finite, record

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
    """N copies of a vehicle with a task; rows of their reports are in `thruster_env.auv.engine.encoding`."""

    reported = REPORTED

    def __init__(self, plant: Plant, task: Task, count: int):
        """Allocate the memory of `count` copies; `begin` comes next."""
        self.plant, self.task = plant, task
        self.commands = tuple(range(COMMAND, COMMAND + len(plant.inputs)))
        numbers, rows = encode(plant, task)
        super().__init__(count, numbers, FIXED_ROWS + rows)

    def machine_code(self) -> tuple[Callable, CompiledOrPython]:
        """The compiled step, the same for every plant and task."""
        return machine_code()

    def numbers_from(self, options: Mapping | None) -> np.ndarray | None:
        """Numbers for `begin` with the initial state that a reset's options fix in "state", or None."""
        start = checked_options(options).get("state")
        if start is None:
            return None
        state = checked_state("the state of options", start)
        return encode(self.plant._replace(initial_mean=state, initial_cov=np.zeros((N, N))), self.task)[0]


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
