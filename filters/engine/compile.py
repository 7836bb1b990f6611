"""From kernels to compiled steps and trajectories, one belief at a time or eight side by side.

The memory of eight beliefs is interleaved: number i of belief j is `rows[group, 8 i + j]`. Each stage of a step
runs over four such groups, whose instructions the processor overlaps.

`graphs.loops` translates the loops around the stages, and LLVM compiles those of a batch once for all filters of a
size of model: they call the stages by their addresses.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from math import inf
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from filters.engine.belief import LARGEST, Kernels, memory_offsets, restart_if_lost
from thruster_env.core.compiled import is_interpreting
from thruster_env.core.streams import GROUP
from thruster_env.model.shape import LANES, number_offsets, padded

if TYPE_CHECKING:
    from thruster_env.graphs.loops import Entry
    from thruster_env.graphs.machine_code import Code

GROUPS = 4  # which each stage runs one after the other, so that their instructions overlap


class Stages(NamedTuple):
    """What a batch calls: functions (row, given, numbers) of a group of beliefs, or of one with its ensemble.

    As arguments of machine code they are addresses, so that filters with other memory share the loops around them.
    """

    start: Any  # given is memory for a belief
    begin: Any  # what comes before the substeps of a prediction, or all of it
    advance: Any
    finish: Any
    update: Any
    restart: Any  # given is memory for a belief


def _stages(kernels: Kernels) -> Stages:
    """The functions that a batch calls; those that it does not call are None."""
    start, restart = kernels.start, restart_if_lost(kernels)
    if not kernels.vectors:
        parts = _of_memory(kernels.predict), None, None, _of_memory(kernels.update)
        return Stages(_without_given(start), *parts, _without_given(restart))

    def start_group(row, belief, numbers):
        for i in range(belief.shape[0]):
            belief[i] = 0.0
        start((belief, None, None), numbers, 0)
        for i in range(belief.shape[0]):
            for j in range(LANES):
                row[i * LANES + j] = belief[i]

    def restart_group(row, belief, numbers):
        for j in range(LANES):
            for i in range(belief.shape[0]):
                belief[i] = row[i * LANES + j]
            restart((belief, None, None), numbers, 0)
            for i in range(belief.shape[0]):
                row[i * LANES + j] = belief[i]

    return Stages._make([start_group, *kernels.vectors, restart_group])


def _of_memory(function: Callable) -> Callable:
    def stage(row, given, numbers, table, draws, size):
        function((row, table, draws), given, numbers, size)

    return stage


def _without_given(function: Callable) -> Callable:
    def stage(row, belief, numbers, table, draws, size):
        function((row, table, draws), numbers, size)

    return stage


def _lanes(side_by_side: bool) -> tuple[int, int]:
    """How many beliefs lie side by side, and how many such groups there are."""
    return (LANES, GROUPS) if side_by_side else (1, 1)


@lru_cache(maxsize=64)
def build_batch(n: int, m: int, t: int, channels: int, side_by_side: bool) -> Callable:
    """`run` of `batch` for beliefs of this size, one after the other or side by side, as a Python function.

    Copies of the last trajectory fill up a group.
    """
    width, groups = _lanes(side_by_side)
    layout, source = memory_offsets(n, m, t), number_offsets(n, m, t)
    mean, cov, innovation, s = layout.mean, layout.cov, layout.innovation, layout.innovation_cov
    key_0, key_1, step, divergences = layout.key_0, layout.key_1, layout.step, layout.divergences
    log_likelihood, checked = layout.log_likelihood, layout.gain
    substeps, q_offset, r_offset = source.substeps, source.q, source.r

    def run(stages, keys, inputs, measurements, numbers, noise, out, memory, first, last):
        start, begin, advance, finish, update, restart = stages
        qs, rs = noise
        means, covs, innovations, innovation_covs, log_likelihoods, counts = out
        rows, us, zs, belief, ensemble = memory
        for b in range(first, last, groups * width):
            count = min(groups * width, last - b)
            used = (count + width - 1) // width
            for g in range(used):
                rows[g, key_0] = keys[b, 0]
                rows[g, key_1] = keys[b, 1]
                rows[g, step] = 0.0
                rows[g, divergences] = 0.0
                start(rows[g], belief, numbers, *ensemble)
            for k in range(measurements.shape[1]):
                if k > 0:
                    for g in range(used):
                        for j in range(width):
                            for i in range(inputs.shape[2]):
                                us[g, i * width + j] = inputs[b + min(g * width + j, count - 1), k - 1, i]
                    if qs.shape[0] > 0:
                        first_number = 0 if qs.shape[1] == numbers.shape[0] else q_offset
                        for i in range(qs.shape[1]):
                            numbers[first_number + i] = qs[k - 1, i]
                    for g in range(used):
                        begin(rows[g], us[g], numbers, *ensemble)
                    if side_by_side:
                        for _ in range(int(numbers[substeps])):
                            for g in range(used):
                                advance(rows[g], us[g], numbers, *ensemble)
                        for g in range(used):
                            finish(rows[g], us[g], numbers, *ensemble)
                if rs.shape[0] > 0:
                    for i in range(rs.shape[1]):
                        numbers[r_offset + i] = rs[k, i]
                for g in range(used):
                    for j in range(width):
                        for i in range(channels):
                            zs[g, i * width + j] = measurements[b + min(g * width + j, count - 1), k, i]
                total, least = 0.0, 0.0
                for g in range(used):
                    update(rows[g], zs[g], numbers, *ensemble)
                    for i in range(checked * width):
                        total += abs(rows[g, i])
                    for i in range(t):
                        for j in range(width):
                            variance = rows[g, (cov + i * (t + 1)) * width + j]
                            least = variance if variance < least else least
                if not (total < LARGEST and least >= 0.0):
                    for g in range(used):
                        restart(rows[g], belief, numbers, *ensemble)
                for j in range(count):
                    g, at = j // width, j % width
                    for i in range(n):
                        means[b + j, k, i] = rows[g, (mean + i) * width + at]
                    for i in range(t):
                        for i_2 in range(t):
                            covs[b + j, k, i, i_2] = rows[g, (cov + i * t + i_2) * width + at]
                    for i in range(m):
                        innovations[b + j, k, i] = rows[g, (innovation + i) * width + at]
                        for i_2 in range(m):
                            innovation_covs[b + j, k, i, i_2] = rows[g, (s + i * m + i_2) * width + at]
                    log_likelihoods[b + j, k] = rows[g, log_likelihood * width + at]
            for j in range(count):
                counts[b + j] = rows[j // width, divergences * width + j % width]

    return run


START, PREDICT, UPDATE = 1, 2, 4  # tasks of an operation; a sum is several
REFUSED = -1  # the result for an input that is not finite or an infinite measurement, which changes nothing


def build_operation(kernels: Kernels) -> Callable:
    """`operation` as a Python function."""
    start, predict, update, summarise = kernels.start, kernels.predict, kernels.update, kernels.summarise
    layout, channels = kernels.layout, kernels.channels
    step, divergences = layout.step, layout.divergences
    restart = restart_if_lost(kernels)

    def operate(row, table, draws, size, values, numbers, task):
        memory, inputs = (row, table, draws), values.shape[0] - channels
        for i in range(values.shape[0]):
            if i < inputs:
                wrong = task & PREDICT and not abs(values[i]) < inf
            else:
                wrong = task & UPDATE and abs(values[i]) == inf
            if wrong:
                return REFUSED
        if task & START:
            row[step] = 0.0
            row[divergences] = 0.0
            start(memory, numbers, size)
        if task & PREDICT:
            predict(memory, values[:inputs], numbers, size)
        if task & UPDATE:
            update(memory, values[inputs:], numbers, size)
            restart(memory, numbers, size)
        else:
            summarise(memory, size)
        return int(row[divergences])

    return operate


def operation_on(kernels: Kernels, given: tuple) -> Callable[[int], int]:
    """`operate(task)` on a session's memory: given = (*memory, size, values, numbers), which stay where they are.

    It works on one belief, and returns its number of restarts, or REFUSED. values = (u, z) in one array; task is a
    sum of START, PREDICT and UPDATE.
    """
    code = None if is_interpreting() else _code_one_by_one(kernels)
    if code is None:
        return partial(_as_python(build_operation(kernels)), *given)
    from thruster_env.graphs.machine_code import builtin_of

    return builtin_of(code, *given)


def batch(kernels: Kernels) -> Callable:
    """`run(keys, inputs, measurements, numbers, noise, out, memory, first, last)` on trajectories.

    noise = (qs, rs) has a row (Q, its root) for each step, or one of all numbers, and a row (R, its root) for each
    measurement, in place of the model's, or no rows. They are written into `numbers`, so threads must not share
    these; `memory` is that of `batch_memory`.
    """
    size = kernels.n, kernels.m, kernels.t, kernels.channels, bool(kernels.vectors)
    codes = () if is_interpreting() else _codes_of_stages(kernels)
    loops = _code_of_batch(*size) if codes else None
    if loops is None:
        return partial(_as_python(build_batch(*size)), _stages(kernels))
    from thruster_env.graphs.machine_code import function_of

    addresses = {name: address for code in codes for name, address in code.addresses.items()}
    return partial(function_of(loops, *codes), Stages(*(addresses.get(name, 0) for name in Stages._fields)))


def _as_python(function: Callable) -> Callable:
    return np.errstate(all="ignore")(function)  # machine code does not warn of overflow either


@lru_cache(maxsize=64)
def _code_one_by_one(kernels: Kernels) -> Code | None:
    """Machine code of `operate`, and of the stages if batches do not run side by side."""
    from thruster_env.graphs.loops import Entry, common_code_of

    operation = Entry(
        build_operation(kernels), (*_memory_shapes(kernels), None, (None,), (None,), None), as_builtin=True
    )
    return common_code_of(operation, *(() if kernels.vectors else _entries(kernels, Stages._fields)))


@lru_cache(maxsize=64)
def _codes_of_stages(kernels: Kernels) -> tuple[Code, ...]:
    """Machine code of the stages; filters of the same model share what starts beliefs side by side."""
    from thruster_env.graphs.loops import common_code_of

    if not kernels.vectors:
        code = _code_one_by_one(kernels)
        return () if code is None else (code,)
    around = "start", "restart"
    parts = around, [name for name in Stages._fields if name not in around]
    codes = [common_code_of(*_entries(kernels, names), unrolled=False) for names in parts]
    return tuple(code for code in codes if code is not None) if None not in codes else ()


def _entries(kernels: Kernels, names: Sequence[str]) -> list[Entry]:
    """Stages of a batch by address."""
    from thruster_env.graphs.loops import Entry

    row, table, draws = _memory_shapes(kernels)
    shapes = [(None,), (None,), (None,)] if kernels.vectors else [row, (None,), (None,), table, draws, None]
    stages = _stages(kernels)._asdict()
    return [Entry(stages[name], shapes, name=name) for name in names if stages[name] is not None]


def _memory_shapes(kernels: Kernels) -> tuple:
    return (row_length(kernels),), (kernels.table_rows, None), (None,)


@lru_cache(maxsize=64)
def _code_of_batch(n: int, m: int, t: int, channels: int, side_by_side: bool) -> Code | None:
    """Machine code of the loops around the stages of any filter of this size."""
    from thruster_env.graphs.loops import ADDRESS, machine_code_of

    width, groups = _lanes(side_by_side)
    noise = [(None, None), (None, 2 * m * m)]
    out = [(None, None, *part) for part in ((n,), (t, t), (m,), (m, m), ())] + [(None,)]
    ensemble = [] if side_by_side else [(None, None), (None,), None]
    memory = [*((groups, size) for size in (None, None, channels * width)), (None,), ensemble]
    data = (None, 2), (None, None, None), (None, None, channels), (None,)
    shapes = Stages(*[ADDRESS] * len(Stages._fields)), *data, noise, out, memory, None, None
    return machine_code_of(build_batch(n, m, t, channels, side_by_side), shapes, unrolled=not side_by_side)


def row_length(kernels: Kernels) -> int:
    """Length of the row of a belief."""
    return kernels.layout.extras + kernels.extras + kernels.scratch


def new_memory(kernels: Kernels, size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Row, table and draws for one belief with `size` members, zeros."""
    width = padded(size, LANES)
    draws = padded(kernels.draws_per_member * width, GROUP)
    return np.zeros(row_length(kernels)), np.zeros((kernels.table_rows, width)), np.zeros(draws)


def batch_memory(kernels: Kernels, size: int, inputs: int) -> tuple:
    """The memory of a batch: groups of rows, inputs and measurements; a belief's row; table, draws and size."""
    (row, *ensemble), (width, groups) = new_memory(kernels, size), _lanes(bool(kernels.vectors))
    in_groups = (np.zeros((groups, count * width)) for count in (len(row), inputs, kernels.channels))
    return *in_groups, row, () if kernels.vectors else (*ensemble, size)
