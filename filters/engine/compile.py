"""From kernels to compiled steps and trajectories, one belief at a time or eight side by side.

The memory of eight beliefs is interleaved: number i of belief j is `rows[group, 8 i + j]`. Each stage of a step
runs over four such groups, whose instructions the processor overlaps.

`graphs.loops` translates the loops around the stages, and LLVM compiles both together.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial
from math import inf
from typing import TYPE_CHECKING

import numpy as np

from filters.engine.belief import LARGEST, Kernels, restart_if_lost
from thruster_env.core.compiled import is_interpreting
from thruster_env.core.streams import GROUP
from thruster_env.model.shape import LANES, padded

if TYPE_CHECKING:
    from thruster_env.graphs.machine_code import Code

GROUPS = 4  # which each stage runs one after the other, so that their instructions overlap


def build_side_by_side(kernels: Kernels) -> Callable:
    """Return `run(inputs, measurements, numbers, noise, out, memory, first, last)`.

    It filters runs first ... last - 1 by `kernels.vectors`. Copies of the last run fill up a group. The memory is
    that of `memory_side_by_side`; for the other arguments see `batch`.
    """
    n, m, start = kernels.n, kernels.m, kernels.start
    begin, advance, finish, update = kernels.vectors
    t, layout, source, width, groups = kernels.t, kernels.layout, kernels.offsets, LANES, GROUPS
    mean, cov, innovation, s = layout.mean, layout.cov, layout.innovation, layout.innovation_cov
    divergences, log_likelihood, substeps = layout.divergences, layout.log_likelihood, source.substeps
    q_offset, r_offset, checked = source.q, source.r, layout.gain
    length, restart = row_length(kernels), restart_if_lost(kernels)

    def run(inputs, measurements, numbers, noise, out, memory, first, last):
        qs, rs = noise
        means, covs, innovations, innovation_covs, log_likelihoods, counts = out
        belief, rows, us, zs = memory
        for b in range(first, last, groups * width):
            count = min(groups * width, last - b)
            used = (count + width - 1) // width
            for i in range(length):
                belief[i] = 0.0
            start((belief, None, None), numbers, 0)
            for g in range(used):
                for i in range(length):
                    for j in range(width):
                        rows[g, i * width + j] = belief[i]
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
                        begin(rows[g], us[g], numbers)
                    for _ in range(int(numbers[substeps])):
                        for g in range(used):
                            advance(rows[g], us[g], numbers)
                    for g in range(used):
                        finish(rows[g], us[g], numbers)
                if rs.shape[0] > 0:
                    for i in range(rs.shape[1]):
                        numbers[r_offset + i] = rs[k, i]
                for g in range(used):
                    for j in range(width):
                        for i in range(m):
                            zs[g, i * width + j] = measurements[b + min(g * width + j, count - 1), k, i]
                total, least = 0.0, 0.0
                for g in range(used):
                    update(rows[g], zs[g], numbers)
                    for i in range(checked * width):
                        total += abs(rows[g, i])
                    for i in range(t):
                        for j in range(width):
                            variance = rows[g, (cov + i * (t + 1)) * width + j]
                            least = variance if variance < least else least
                if not (total < LARGEST and least >= 0.0):
                    for g in range(used):
                        for j in range(width):
                            for i in range(length):
                                belief[i] = rows[g, i * width + j]
                            restart((belief, None, None), numbers, 0)
                            for i in range(length):
                                rows[g, i * width + j] = belief[i]
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


def memory_side_by_side(kernels: Kernels, inputs: int) -> tuple[np.ndarray, ...]:
    """One belief, and the memory, inputs and measurements of all groups, zeros."""
    length, width = row_length(kernels), LANES
    groups = (np.zeros((GROUPS, size * width)) for size in (length, inputs, kernels.m))
    return np.zeros(length), *groups


START, PREDICT, UPDATE = 1, 2, 4  # tasks of an operation; a sum is several
REFUSED = -1  # the result for an input that is not finite or an infinite measurement, which changes nothing


def build_operation(kernels: Kernels) -> Callable:
    """`operation` as a Python function."""
    start, predict, update, summarise = kernels.start, kernels.predict, kernels.update, kernels.summarise
    layout, m = kernels.layout, kernels.m
    step, divergences = layout.step, layout.divergences
    restart = restart_if_lost(kernels)

    def operate(row, table, draws, size, values, numbers, task):
        memory, inputs = (row, table, draws), values.shape[0] - m
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


def _build_batch(kernels: Kernels) -> Callable:
    n, m, start, predict, update = kernels.n, kernels.m, kernels.start, kernels.predict, kernels.update
    t, layout = kernels.t, kernels.layout
    mean, cov, innovation, s = layout.mean, layout.cov, layout.innovation, layout.innovation_cov
    key_0, key_1, step, divergences = layout.key_0, layout.key_1, layout.step, layout.divergences
    log_likelihood = layout.log_likelihood
    q_offset, r_offset = kernels.offsets.q, kernels.offsets.r
    restart = restart_if_lost(kernels)

    def batch(row, table, draws, size, keys, inputs, measurements, numbers, noise, out, first, last):
        qs, rs = noise
        means, covs, innovations, innovation_covs, log_likelihoods, counts = out
        memory = (row, table, draws)
        u, z = np.zeros(inputs.shape[2]), np.zeros(m)
        for b in range(first, last):
            row[key_0] = keys[b, 0]
            row[key_1] = keys[b, 1]
            row[step] = 0.0
            row[divergences] = 0.0
            start(memory, numbers, size)
            for k in range(measurements.shape[1]):
                # Entry by entry: a slice of an array that threads share costs a contended reference count.
                if k > 0:
                    for i in range(u.shape[0]):
                        u[i] = inputs[b, k - 1, i]
                    if qs.shape[0] > 0:
                        first_number = 0 if qs.shape[1] == numbers.shape[0] else q_offset
                        for i in range(qs.shape[1]):
                            numbers[first_number + i] = qs[k - 1, i]
                    predict(memory, u, numbers, size)
                for i in range(m):
                    z[i] = measurements[b, k, i]
                if rs.shape[0] > 0:
                    for i in range(rs.shape[1]):
                        numbers[r_offset + i] = rs[k, i]
                update(memory, z, numbers, size)
                restart(memory, numbers, size)
                for i in range(n):
                    means[b, k, i] = row[mean + i]
                for i in range(t):
                    for j in range(t):
                        covs[b, k, i, j] = row[cov + i * t + j]
                for i in range(m):
                    innovations[b, k, i] = row[innovation + i]
                    for j in range(m):
                        innovation_covs[b, k, i, j] = row[s + i * m + j]
                log_likelihoods[b, k] = row[log_likelihood]
            counts[b] = row[divergences]

    return batch


def operation_on(kernels: Kernels, given: tuple) -> Callable[[int], int]:
    """`operate(task)` on a session's memory: given = (*memory, size, values, numbers), which stay where they are.

    It works on one belief, and returns its number of restarts, or REFUSED. values = (u, z) in one array; task is a
    sum of START, PREDICT and UPDATE.
    """
    code = None if is_interpreting() else _code_one_by_one(kernels)
    if code is None:
        return partial(_as_python(build_operation, kernels), *given)
    from thruster_env.graphs.machine_code import builtin_of

    return builtin_of(code, *given)


def batch(kernels: Kernels) -> Callable:
    """`batch(*memory, size, keys, inputs, measurements, numbers, noise, out, first, last)` on trajectories.

    noise = (qs, rs) has a row (Q, its root) for each step, or one of all numbers, and a row (R, its root) for each
    measurement, in place of the model's, or no rows. They are written into `numbers`, so threads must not share
    these.
    """
    return _function(None if is_interpreting() else _code_one_by_one(kernels), _build_batch, kernels)


def vectors(kernels: Kernels) -> Callable:
    """`run` of `build_side_by_side`, for kernels that have vectors."""
    return _function(None if is_interpreting() else _code_side_by_side(kernels), build_side_by_side, kernels)


def _function(code: Code | None, build: Callable, kernels: Kernels) -> Callable:
    if code is None:
        return _as_python(build, kernels)
    from thruster_env.graphs.machine_code import function_of

    return function_of(code)


@lru_cache(maxsize=128)
def _as_python(build: Callable, kernels: Kernels) -> Callable:
    return np.errstate(all="ignore")(build(kernels))  # machine code does not warn of overflow either


@lru_cache(maxsize=64)
def _code_one_by_one(kernels: Kernels) -> Code | None:
    """Machine code of `operate`, and of `batch` if batches do not run side by side."""
    from thruster_env.graphs.loops import Entry, common_code_of

    memory = (row_length(kernels),), (kernels.table_rows, None), (None,), None
    entries = [Entry(build_operation(kernels), (*memory, (None,), (None,), None), as_builtin=True)]
    if not kernels.vectors:
        shapes = *memory, (None, 2), (None, None, None), *_shapes_of_data(kernels), None, None
        entries.append(Entry(_build_batch(kernels), shapes))
    return common_code_of(*entries)


@lru_cache(maxsize=64)
def _code_side_by_side(kernels: Kernels) -> Code | None:
    from thruster_env.graphs.loops import machine_code_of

    length, m = row_length(kernels), kernels.m
    memory = [(length,), (GROUPS, length * LANES), (GROUPS, None), (GROUPS, m * LANES)]
    shapes = (None, None, None), *_shapes_of_data(kernels), memory, None, None
    return machine_code_of(build_side_by_side(kernels), shapes, unrolled=False)


def _shapes_of_data(kernels: Kernels) -> tuple:
    """Lengths of measurements, numbers, noise and estimates."""
    n, m, t = kernels.n, kernels.m, kernels.t
    noise = [(None, None), (None, 2 * m * m)]
    out = [(None, None, *part) for part in ((n,), (t, t), (m,), (m, m), ())] + [(None,)]
    return (None, None, m), (None,), noise, out


def row_length(kernels: Kernels) -> int:
    """Length of the row of a belief."""
    return kernels.layout.extras + kernels.extras + kernels.scratch


def new_memory(kernels: Kernels, size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Row, table and draws for one belief with `size` members, zeros."""
    width = padded(size, LANES)
    draws = padded(kernels.draws_per_member * width, GROUP)
    return np.zeros(row_length(kernels)), np.zeros((kernels.table_rows, width)), np.zeros(draws)
