"""The noisy vehicle, any number of copies advanced one sample time by one compiled function.

    x_{k+1} = F(x_k, u_k) + w_k,  w ~ N(0, Q);      z_{k+1} = h(x_{k+1}) + v_{k+1},  v ~ N(0, R)

F integrates the equations of motion over one sample time, in the current; h are the channels. A single env is one
copy, so the same seed gives the same numbers on every path. One step: commands, current, motion, process noise,
measurement, sensor effects, reward, the vehicle's own reckoning.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

from thruster_env.auv.channels import CHANNELS
from thruster_env.auv.engine.encoding import known_effects
from thruster_env.auv.engine.guidance import find_errors, find_reward, find_true_errors, reckon, step_depth
from thruster_env.auv.engine.memory import (
    CHANNEL_CODES,
    CHANNEL_COUNT,
    CURRENT,
    FIRST_EFFECT,
    PRIOR_ROOT,
    Q_ROOT,
    R_ROOT,
    READINGS,
    REPORTED,
    SAMPLE_TIME,
    SCRATCH,
    SECTIONS,
    STATE,
    STEEPEST,
    THETA,
    VALID,
    N,
)
from thruster_env.auv.engine.motion import begin_at_mean, move, read_state, take_commands
from thruster_env.auv.noise import add_noise
from thruster_env.core.compiled import CompiledOrPython, inlined
from thruster_env.core.memory import FIRST_REPORTED, REWARD, STEP, TERMINATED, TIME
from thruster_env.core.streams import INITIAL, MEASUREMENT, PROCESS
from thruster_env.effects.chains import chain_of
from thruster_env.env.channels import Channel, reader_of
from thruster_env.env.copies import machine_code_of

LARGEST = 1e12  # of the sum of a state's magnitudes: beyond it, or where it is no number, an episode ends


def _of_copy(read: Callable) -> Callable:
    """Read one channel of copy j."""
    return inlined(lambda memory, b, j: read(read_state(memory, b, j), (), (), ()))


@inlined
def _tell_time_and_end(memory, b, numbers):
    steepest = numbers[STEEPEST]
    for j in range(memory.shape[2]):
        memory[b, TIME, j] = memory[b, STEP, j] * numbers[SAMPLE_TIME]
        size = 0.0
        for i in range(N):
            size += abs(memory[b, STATE + i, j])
        kept = abs(memory[b, STATE + THETA, j]) < steepest and size < LARGEST
        memory[b, TERMINATED, j] = 0.0 if kept else 1.0


def machine_code() -> tuple[Callable, CompiledOrPython]:
    """The compiled `step(first, last, memory, numbers, out, begin)` of vehicles: `thruster_env.env.copies`."""
    return machine_code_of(_step(known_effects(), tuple(sorted(CHANNELS.values(), key=lambda one: one.code))))


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
