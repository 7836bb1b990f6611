"""Operations of one step of an env, of a filter and of noise, for the arithmetic limits of the rows."""

from __future__ import annotations

from collections import Counter

import gymnasium as gym
import numpy as np

from benchmarks.counting import counting
from filters.engine.compile import new_memory
from filters.filter import Filter
from thruster_env.core.compiled import interpreted
from thruster_env.core.streams import FILTER_PROCESS, normal_block

NORMALS = 4  # that one block of the generator makes
FEW = 8, 16  # members that are enough to count, whole vector registers of them


def step_of_env(env: gym.Env) -> Counter[str]:
    """Operations of one step of an env's plant, its noise and what it reports included."""
    with interpreted():
        copies = env.unwrapped.copies_of(1)
        copies.begin(np.array([[1.0, 2.0]]))
    with counting() as graph:
        memory, out = graph.variables(copies.memory), np.zeros((copies.reported, 2, 1))
        copies.advance(0, 1, memory, copies.numbers, out, False)
    return graph.operations(memory, out)


def step_of_filtered(env: gym.Env) -> Counter[str]:
    """The same of an env and the filter around it."""
    return step_of_env(env) + step_of_filter(env.get_wrapper_attr("filter"))


def step_of_filter(filter_: Filter) -> Counter[str]:
    """Operations of one prediction and one update, of all members where there are some."""
    if filter_.size <= FEW[1]:
        return step_of_members(filter_, filter_.size)
    fixed, a_member = step_by_size(filter_)
    return fixed + times(a_member, filter_.size)


def step_by_size(filter_: Filter, few: tuple[int, int] = FEW) -> tuple[Counter[str], Counter[str]]:
    """Operations of a step of an ensemble filter without its members, and of each member: within 2 % a line."""
    first, second = (step_of_members(filter_, size) for size in few)
    a_member = times(second - first, 1 / (few[1] - few[0]))
    return first - times(a_member, few[0]), a_member


def step_of_members(filter_: Filter, size: int) -> Counter[str]:
    """The same with so many members, all of them counted."""
    kernels, model, numbers = filter_.kernels(), filter_.kernel_model, filter_.numbers
    memory = new_memory(kernels, size)
    with interpreted():
        kernels.start(memory, numbers, size)
    with counting() as graph:
        row, table, draws = memory = tuple(graph.variables(part) for part in memory)
        u, z = (graph.variables(np.ones(count)) for count in (model.inputs, model.m))
        kernels.predict(memory, u, numbers, size)
        kernels.update(memory, z, numbers, size)
    return graph.operations(row, table[: model.n, :size])


def normals(count: int) -> Counter[str]:
    """Operations of so many standard normals."""
    with counting() as graph:
        (block,) = graph.variables(np.arange(1))
        drawn = np.array(normal_block(block, 1, FILTER_PROCESS, 2, 3), dtype=object)
    return times(graph.operations(drawn), count / NORMALS)


def times(count: Counter[str], factor: float) -> Counter[str]:
    """The operations multiplied by a factor."""
    return Counter({kind: factor * number for kind, number in count.items()})
