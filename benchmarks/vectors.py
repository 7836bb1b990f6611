"""Thousands of thrusters at once: the native vector env, and what its equations of motion cost at least."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from functools import cache
from time import perf_counter

import gymnasium as gym
import numpy as np

import thruster_env  # noqa: F401 - registers BowThruster-v0
from benchmarks.rows import Row
from benchmarks.timing import Measure, side_by_side
from numerics.compiled import compiled, function_fingerprint
from numerics.threads import spread
from plants.memory import set_row
from thruster_env.dynamics import substep
from thruster_env.engine.copies import Copies
from thruster_env.engine.memory import COMMAND, SUBSTEPS, VOLTAGE
from thruster_env.engine.motion import move_thruster
from thruster_env.plant import make_plant
from thruster_env.task import Task

COPIES, STEPS = 8192, 200
PROPAGATED = 65536
WIDTH, REPEATS = 1024, 200  # of the loops that measure the machine's arithmetic


def rows(seed: int, quick: bool) -> Iterator[Row]:
    """Measure, one row after the other."""
    rounds = 5 if quick else 40
    ours, peer = vector_steps("BowThruster-v0", seed), vector_steps("CartPole-v1", seed)
    timing = side_by_side(ours, peer, rounds)
    yield Row(f"vector env, {COPIES} copies", "CartPole-v1", timing, ratio_goal=1 / 2.5)

    motion, limit = propagation(), arithmetic_limit()
    timing = side_by_side(motion, limit, rounds)
    yield Row(f"Runge-Kutta step, {PROPAGATED} copies", "arithmetic limit", timing, time_goal=1 / 400e6)


def memory_line() -> str:
    """Memory of a copy, in words."""
    env = gym.make_vec("BowThruster-v0", num_envs=COPIES)
    return f"Memory: {env.unwrapped.bytes_per_copy} bytes a copy of the vector env while it steps."


def vector_steps(name: str, seed: int, copies: int = COPIES, steps: int = STEPS, **arguments) -> Measure:
    """A measure of one copy's step in a vector env of many copies under random actions."""
    env = gym.make_vec(name, num_envs=copies, **arguments)
    env.action_space.seed(seed)
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


class Counted:
    """A number that counts the operations done with it, by kind."""

    def __init__(self, count: Counter):
        """Take the counter that all of a computation share."""
        self.count = count

    def _note(self, kind: str) -> Counted:
        self.count[kind] += 1
        return self

    def __add__(self, other):
        return self._note("+")

    def __mul__(self, other):
        return self._note("*")

    def __truediv__(self, other):
        return self._note("/")

    def __pow__(self, power):
        return self._note("root")

    def __abs__(self):
        return self  # a mask; free beside the others

    __radd__ = __sub__ = __rsub__ = __add__
    __rmul__ = __mul__
    __rtruediv__ = __truediv__


def operations() -> Counter:
    """Operations of one Runge-Kutta step, counted by running the very source on numbers that count."""
    count = Counter()
    substep((Counted(count), Counted(count)), (12.0, 0.0), make_plant().constants)
    return count


def arithmetic_limit() -> Measure:
    """A measure of the time that a step's operations would take, each kind at the machine's best rate.

    Additions and multiplications come in pairs, a fused instruction for both; each rate is that of a vector loop
    on all cores in the fastest cache.
    """
    count = operations()
    fused, root = _arithmetic()
    data = np.linspace(1.0, 2.0, WIDTH)

    def seconds(work: Callable, per_call: int) -> float:
        def part(first, last):
            for _ in range(first, last):
                work(data.copy(), REPEATS)

        begin = perf_counter()
        spread(part, 8)
        return (perf_counter() - begin) / (8 * REPEATS * WIDTH * per_call)

    def measure() -> float:
        pairs = max(count["+"], count["*"])
        return pairs * seconds(fused, 32) + count["root"] * seconds(root, 4)

    return measure


@cache
def _arithmetic() -> tuple[Callable, Callable]:
    def fused(data, repeats):
        for _ in range(repeats):
            for j in range(data.shape[0]):
                x = y = z = w = data[j]
                for _ in range(8):
                    x = x * 0.9 + 0.1
                    y = y * 0.8 + 0.2
                    z = z * 0.7 + 0.3
                    w = w * 0.6 + 0.4
                data[j] = 0.25 * (x + y + z + w)

    def root(data, repeats):
        for _ in range(repeats):
            for j in range(data.shape[0]):
                x = data[j]
                for _ in range(4):
                    x = 1.0 / (x + 1.0) ** 0.5
                data[j] = x

    return compiled(fused), compiled(root)
