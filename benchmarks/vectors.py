"""Thousands of thrusters at once: the native vector env, and a Runge-Kutta step of its equations of motion."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache
from time import perf_counter

import gymnasium as gym
import numpy as np

import thruster_env  # noqa: F401 - registers BowThruster-v0
from benchmarks.rates import arithmetic_limit, operations_of, step_of_env
from benchmarks.timing import Measure, Row, alone, side_by_side
from thruster_env.core.compiled import compiled, function_fingerprint
from thruster_env.core.memory import set_row
from thruster_env.core.streams import ACTION_SPACE, derived_seed
from thruster_env.core.threads import cores, spread
from thruster_env.thruster.dynamics import substep
from thruster_env.thruster.plant import make_plant
from thruster_env.thruster.simulation import COMMAND, SUBSTEPS, VOLTAGE, Copies, move_thruster
from thruster_env.thruster.task import Task

COPIES, STEPS = 8192, 200
PROPAGATED = 65536
LIMIT_GOAL = 1.8


def rows(seed: int, quick: bool) -> Iterator[Row]:
    """Measure, one row after the other."""
    rounds = 5 if quick else 40
    ours, peer = vector_steps("BowThruster-v0", seed), vector_steps("CartPole-v1", seed)
    timing = side_by_side(ours, peer, rounds)
    limit = arithmetic_limit(step_of_env(gym.make("BowThruster-v0")), cores=cores())
    yield Row(f"vector env, {COPIES} copies", "CartPole-v1", timing, ratio_goal=0.4, limit=limit)

    count = operations_of(substep, np.zeros(2), (12.0, 0.0), make_plant().constants)
    limit, timing = arithmetic_limit(count, cores=cores()), alone(propagation(), rounds)
    yield Row(f"Runge-Kutta step, {PROPAGATED} copies", None, timing, limit=limit, limit_goal=LIMIT_GOAL)


def memory_line() -> str:
    """Memory of a copy, in words."""
    env = gym.make_vec("BowThruster-v0", num_envs=COPIES)
    return f"Memory: {env.unwrapped.bytes_per_copy} bytes a copy of the vector env while it steps."


def vector_steps(name: str, seed: int, copies: int = COPIES, steps: int = STEPS, **arguments) -> Measure:
    """A measure of one copy's step in a vector env of many copies under random actions."""
    env = gym.make_vec(name, num_envs=copies, **arguments)
    env.action_space.seed(derived_seed(seed, ACTION_SPACE))
    actions = env.action_space.sample()

    def measure() -> float:
        env.reset(seed=seed)
        begin = perf_counter()
        for _ in range(steps):
            env.step(actions)
        return (perf_counter() - begin) / (steps * copies)

    return measure


def propagation() -> Measure:
    """A measure of one Runge-Kutta step of one copy without noise, many copies on all cores."""
    plant = make_plant()
    copies = Copies(plant, Task(), PROPAGATED)
    memory, numbers = copies.memory, copies.numbers
    for row in (COMMAND, VOLTAGE):
        set_row(memory, row, np.full(PROPAGATED, 12.0))
    move, calls = _propagate(), 10

    def measure() -> float:
        begin = perf_counter()
        spread(lambda first, last: move(memory, numbers, calls, first, last), len(memory))
        return (perf_counter() - begin) / (calls * plant.substeps * PROPAGATED)

    assert numbers[SUBSTEPS] == plant.substeps
    return measure


@cache
def _propagate() -> Callable:
    fingerprint = function_fingerprint(within=__name__)

    def propagate(memory, numbers, calls, first, last):
        fingerprint  # noqa: B018 - part of the cache's key
        for b in range(first, last):
            for _ in range(calls):
                move_thruster(memory, b, numbers)

    return compiled(propagate)
