"""Batch session: one belief for each copy of a vector env, all advanced in place by one compiled call."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from filters.engine.belief import Kernels
from filters.engine.checks import vector_like
from filters.engine.compile import PREDICT, START, UPDATE, build_operation, new_memory
from filters.engine.layout import memory_places
from filters.filter import Filter
from thruster_env.core.compiled import CompiledOrPython, inlined, is_interpreting
from thruster_env.core.threads import in_parts, worker_threads

THREADED_COPIES = 256  # fewer are done before a second thread has woken up
IDLE, STEP, BEGIN = 0, PREDICT + UPDATE, START + UPDATE  # what a copy's belief does in a call


class Beliefs:
    """One filter on N copies, each with its own belief."""

    def __init__(self, filter_: Filter, count: int):
        """Allocate the memory of `count` beliefs; `start` comes next."""
        self._filter = filter_
        self._kernels, self._size, self._numbers = filter_.kernels(), filter_.size, filter_.numbers
        self._places = memory_places(self._kernels.n, self._kernels.m)
        row, table, _ = self._own = new_memory(self._kernels, self._size)
        self._rows = np.zeros((count, len(row)))
        self._tables = np.zeros((count, self._kernels.kept_rows, table.shape[1]))
        self._u, self._z = np.zeros((count, filter_.kernel_model.inputs)), np.zeros((count, self._kernels.m))
        self._operate = _operation(self._kernels, is_interpreting())

    def __getstate__(self) -> tuple:
        """The filter and the beliefs; machine code is looked up again."""
        return self._filter, self._rows, self._tables

    def __setstate__(self, state: tuple) -> None:
        """Continue from the beliefs."""
        filter_, rows, tables = state
        type(self).__init__(self, filter_, len(rows))
        self._rows[:], self._tables[:] = rows, tables

    def start(self, which: np.ndarray, keys: np.ndarray, z: np.ndarray) -> None:
        """Set the prior in some copies with keys (len(which), 2), and update it with measurements z (N, m)."""
        self._rows[which, self._places.key_0] = keys[:, 0]
        self._rows[which, self._places.key_1] = keys[:, 1]
        tasks = np.full(len(self._rows), IDLE)
        tasks[which] = BEGIN
        self._do(tasks, self._u, z)

    def step(self, u: np.ndarray, z: np.ndarray, idle: np.ndarray | None = None) -> None:
        """Predict with inputs u (N, p), then update with measurements z (N, m); NaN marks a missing channel."""
        tasks = np.full(len(self._rows), STEP)
        if idle is not None:
            tasks[idle] = IDLE
        self._do(tasks, u, z)

    def _do(self, tasks: np.ndarray, u: np.ndarray, z: np.ndarray) -> None:
        self._u[:], self._z[:] = u, z
        at_work, predicts = tasks != IDLE, tasks == STEP
        wrong = np.isinf(self._z).any(1) & at_work | ~np.isfinite(self._u).all(1) & predicts
        if wrong.any():
            i = int(np.argmax(wrong))
            if predicts[i]:
                vector_like(f"u of copy {i}", self._u[i], self._u[i], missing_allowed=False)
            vector_like(f"z of copy {i}", self._z[i], self._z[i], missing_allowed=True)
        arrays = tasks, self._rows, self._tables, self._u, self._z
        arguments = *self._own, self._size, *arrays, self._numbers
        worker_threads().run(self._operate, len(tasks), *arguments, alone=len(tasks) < THREADED_COPIES)

    def part(self, name: str, *shape: int) -> np.ndarray:
        """A copy of a part of all memories, such as "mean": (N, *shape)."""
        first = getattr(self._places, name)
        values = self._rows[:, first : first + int(np.prod(shape, dtype=int))]
        return values.reshape(len(values), *shape).copy()


@lru_cache(maxsize=128)
def _operation(kernels: Kernels, interpreting: bool) -> CompiledOrPython:
    operate = inlined(build_operation(kernels))
    kept = kernels.kept_rows

    def operate_many(first, last, row, table, draws, size, tasks, rows, tables, inputs, measurements, numbers):
        # Each thread works in memory of its own: slices of arrays that threads share cost contended counts.
        row, table, draws = np.zeros_like(row), np.zeros_like(table), np.zeros_like(draws)
        p, m = inputs.shape[1], measurements.shape[1]
        given = np.zeros(p + m)
        for b in range(first, last):
            task = tasks[b]
            if task == IDLE:
                continue
            for i in range(row.shape[0]):
                row[i] = rows[b, i]
            if task == STEP:
                for i in range(kept):
                    for j in range(tables.shape[2]):
                        table[i, j] = tables[b, i, j]
            for i in range(p):
                given[i] = inputs[b, i]
            for i in range(m):
                given[p + i] = measurements[b, i]
            operate(row, table, draws, size, given, numbers, task)
            for i in range(row.shape[0]):
                rows[b, i] = row[i]
            for i in range(kept):
                for j in range(tables.shape[2]):
                    tables[b, i, j] = table[i, j]

    return in_parts(operate_many)
