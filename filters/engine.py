"""Running filters: one step of one belief, or whole trajectories of many, from the same kernels."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache, lru_cache
from typing import NamedTuple

import numpy as np

from filters.filter import Belief, Filter, Innovation, Kernels
from filters.rows import LANES, memory_places, padded
from thruster_env.compiled import compilable, compiled, function_fingerprint, is_interpreting
from thruster_env.streams import GROUP


class _Runner:
    """A function made from kernels: compiled if numba can, else as Python with one warning."""

    def __init__(self, build: Callable, kernels: Kernels):
        self._python = build(kernels)
        self.run = compiled(self._python)
        self._proven = self.run is self._python

    def __call__(self, *arguments):
        if self._proven:
            return self.run(*arguments)
        from numba.core.errors import NumbaError

        try:
            result = self.run(*arguments)
        except NumbaError as error:  # raised before anything has run
            reason = str(error).strip().splitlines()[-1]
            warnings.warn(f"the model runs as Python, slowly, for numba refuses it: {reason}", stacklevel=2)
            self.run = self._python
            result = self.run(*arguments)
        self._proven = True
        return result


@cache
def _restart_if_lost(kernels: Kernels) -> Callable:
    """Return a function that puts the prior in place of a belief that is not finite, and counts it."""
    places, start = memory_places(kernels.n, kernels.m), kernels.start
    last, divergences = places.cov + kernels.n**2, places.divergences

    @compilable
    def restart_if_lost(memory, numbers, size):
        row, _, _ = memory
        total = 0.0
        for i in range(last):
            total += abs(row[i])
        if not total < 1e300:
            start(memory, numbers, size)
            row[divergences] += 1.0

    return restart_if_lost


def _build_operation(kernels: Kernels) -> Callable:
    start, predict, update = kernels.start, kernels.predict, kernels.update
    places = memory_places(kernels.n, kernels.m)
    step, divergences = places.step, places.divergences
    restart_if_lost = _restart_if_lost(kernels)
    fingerprint = function_fingerprint(start, predict, update)

    def operate(row, table, draws, size, u, z, numbers, starting, predicting, updating):
        fingerprint  # noqa: B018 - part of the cache's key
        memory = (row, table, draws)
        if starting:
            row[step] = 0.0
            row[divergences] = 0.0
            start(memory, numbers, size)
        if predicting:
            predict(memory, u, numbers, size)
        if updating:
            update(memory, z, numbers, size)
        restart_if_lost(memory, numbers, size)

    return operate


def _build_batch(kernels: Kernels) -> Callable:
    n, m, _, _, start, predict, update = kernels
    places = memory_places(n, m)
    mean, cov, innovation, s = places.mean, places.cov, places.innovation, places.innovation_cov
    key_0, key_1, step, divergences = places.key_0, places.key_1, places.step, places.divergences
    log_likelihood = places.log_likelihood
    restart_if_lost = _restart_if_lost(kernels)
    fingerprint = function_fingerprint(start, predict, update)

    def batch(row, table, draws, size, keys, inputs, measurements, numbers, out, first, last):
        fingerprint  # noqa: B018 - part of the cache's key
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
                    predict(memory, u, numbers, size)
                for i in range(m):
                    z[i] = measurements[b, k, i]
                update(memory, z, numbers, size)
                restart_if_lost(memory, numbers, size)
                for i in range(n):
                    means[b, k, i] = row[mean + i]
                    for j in range(n):
                        covs[b, k, i, j] = row[cov + i * n + j]
                for i in range(m):
                    innovations[b, k, i] = row[innovation + i]
                    for j in range(m):
                        innovation_covs[b, k, i, j] = row[s + i * m + j]
                log_likelihoods[b, k] = row[log_likelihood]
            counts[b] = row[divergences]

    return batch


@lru_cache(maxsize=128)
def _operation(kernels: Kernels, interpreting: bool) -> _Runner:
    return _Runner(_build_operation, kernels)


@lru_cache(maxsize=128)
def _batch(kernels: Kernels, interpreting: bool) -> _Runner:
    return _Runner(_build_batch, kernels)


class Session:
    """One filter at work in place on its own memory: what a wrapper steps and `Filter.predict` borrows.

    Attributes:
        mean, cov, innovation, innovation_cov: views on the memory, (n,), (n, n), (m,), (m, m).
    """

    def __init__(self, filter_: Filter):
        """Allocate the memory of a filter; `start` or `load` comes next."""
        kernels, model = filter_.kernels(), filter_.kernel_model
        n, m = kernels.n, kernels.m
        places = memory_places(n, m)
        self._operate = _operation(kernels, is_interpreting())
        self._numbers, self._size, self._places = model.numbers, filter_.size, places
        self._memory = new_memory(filter_)
        self._row, self._table, _ = self._memory
        self._u, self._z = np.zeros(model.inputs), np.full(m, np.nan)
        self.mean = self._row[places.mean : places.mean + n]
        self.cov = self._row[places.cov : places.cov + n * n].reshape(n, n)
        self.innovation = self._row[places.innovation : places.innovation + m]
        self.innovation_cov = self._row[places.innovation_cov : places.innovation_cov + m * m].reshape(m, m)

    def _do(self, starting: bool, predicting: bool, updating: bool) -> None:
        self._operate(
            *self._memory,
            self._size,
            self._u,
            self._z,
            self._numbers,
            starting,
            predicting,
            updating,
        )

    def set_key(self, key) -> None:
        """Set the key (2,) on which the belief's randomness depends."""
        self._row[self._places.key_0], self._row[self._places.key_1] = key

    def start(self, key, z) -> None:
        """Set the prior with a random key (2,) and update it with a first measurement z (m,)."""
        self.set_key(key)
        self._z[:] = z
        self._do(True, False, True)

    def step(self, u, z) -> None:
        """Predict with input u (p,), then update with measurement z (m,); NaN marks a missing channel."""
        self._u[:] = u
        self._z[:] = z
        self._do(False, True, True)

    def run(self, operation: str, u=None, z=None) -> None:
        """Do one of "start", "predict" or "update" alone, arguments checked."""
        if u is not None:
            self._u[:] = vector_like("u", u, self._u, missing_allowed=False)
        if z is not None:
            self._z[:] = vector_like("z", z, self._z, missing_allowed=True)
        self._do(operation == "start", operation == "predict", operation == "update")

    @property
    def divergences(self) -> int:
        """Restarts from the prior, so far, after an estimate that was not finite."""
        return int(self._row[self._places.divergences])

    def load(self, belief: Belief) -> None:
        """Put a belief into the memory."""
        self.mean[:], self.cov[:] = belief.mean, belief.cov
        self._table[: len(belief.mean), : self._size] = belief.members
        self.set_key(belief.key)
        self._row[self._places.step] = belief.step
        self._row[self._places.divergences] = belief.divergences

    def belief(self) -> Belief:
        """A copy of the belief in the memory."""
        row, places = self._row, self._places
        key = int(row[places.key_0]), int(row[places.key_1])
        members = self._table[: len(self.mean), : self._size].copy()
        return Belief(self.mean.copy(), self.cov.copy(), members, key, int(row[places.step]), self.divergences)

    def innovation_copy(self) -> Innovation:
        """A copy of what the last update found."""
        log_likelihood = float(self._row[self._places.log_likelihood])
        return Innovation(self.innovation.copy(), self.innovation_cov.copy(), log_likelihood)


def new_memory(filter_: Filter) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Row, table and draws for one belief of a filter, zeros."""
    kernels, width = filter_.kernels(), padded(filter_.size, LANES)
    length = memory_places(kernels.n, kernels.m).length
    draws = padded(kernels.draws_per_member * width, GROUP)
    return np.zeros(length), np.zeros((kernels.table_rows, width)), np.zeros(draws)


def vector_like(name: str, value, like: np.ndarray, *, missing_allowed: bool) -> np.ndarray:
    """Return value as float64 of the shape of `like`; raise ValueError for a wrong shape or infinite entries."""
    array = np.atleast_1d(np.asarray(value, dtype=np.float64))
    wrong = np.isinf(array) if missing_allowed else ~np.isfinite(array)
    if array.shape != like.shape or wrong.any():
        rule = "finite or NaN" if missing_allowed else "finite"
        raise ValueError(f"{name} must be {like.size} numbers, each {rule}, but got {value!r}")
    return array


class Estimates(NamedTuple):
    """A filter's output over a batch of B trajectories of K steps; index 0 is after the first measurement."""

    means: np.ndarray  # (B, K + 1, n)
    covs: np.ndarray  # (B, K + 1, n, n)
    innovations: np.ndarray  # (B, K + 1, m)
    innovation_covs: np.ndarray  # (B, K + 1, m, m)
    log_likelihoods: np.ndarray  # (B, K + 1)
    divergences: np.ndarray  # (B,), restarts after an estimate that was not finite


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(_threads(), thread_name_prefix="filters")


def _threads() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def run(filter_: Filter, keys: np.ndarray, inputs: np.ndarray, measurements: np.ndarray) -> Estimates:
    """Filter many trajectories in one compiled call that uses all cores.

    Args:
        filter_: any filter.
        keys: random keys, one a trajectory, (B, 2).
        inputs: u, (B, K, p); the filter predicts with u[:, k] ...
        measurements: ... and updates with z[:, k + 1]; (B, K + 1, m), NaN where missing.

    Returns:
        `Estimates`, the same whatever the number of cores.

    Raises:
        ValueError: if shapes do not fit or an input is not finite.
    """
    kernels, model = filter_.kernels(), filter_.kernel_model
    keys = np.ascontiguousarray(keys, dtype=np.float64)
    inputs = np.ascontiguousarray(inputs, dtype=np.float64)
    z = np.ascontiguousarray(measurements, dtype=np.float64)
    if z.ndim != 3 or inputs.ndim != 3 or keys.shape != (len(z), 2):
        raise ValueError(
            "keys, inputs, measurements must have shapes (B, 2), (B, K, p), (B, K + 1, m), "
            f"but got {keys.shape}, {inputs.shape}, {z.shape}"
        )
    count, times, m = z.shape
    if inputs.shape != (count, times - 1, model.inputs) or m != model.m:
        raise ValueError(
            f"inputs and measurements must have shapes {(count, times - 1, model.inputs)} and "
            f"{(count, times, model.m)}, but got {inputs.shape} and {z.shape}"
        )
    if not np.isfinite(inputs).all() or np.isinf(z).any():
        raise ValueError("inputs must be finite, and measurements finite or NaN, but some are not")
    n = model.n
    out = Estimates(
        np.empty((count, times, n)),
        np.empty((count, times, n, n)),
        np.empty((count, times, m)),
        np.empty((count, times, m, m)),
        np.empty((count, times)),
        np.empty(count),
    )
    batch, numbers = _batch(kernels, is_interpreting()), model.numbers

    def part(first: int, last: int) -> None:
        memory = new_memory(filter_)  # serves the part's trajectories one after the other
        batch(*memory, filter_.size, keys, inputs, z, numbers, tuple(out), first, last)

    spread(part, count)
    return out


def spread(part: Callable[[int, int], None], count: int) -> None:
    """Call part(first, last) on all cores until it has covered 0 ... count; part releases the lock."""
    part(0, 1)  # compile or load once, before threads race for it
    edges = np.unique(np.linspace(1, count, 1 + min(count - 1, 4 * _threads())).astype(int))
    list(_pool().map(part, edges[:-1], edges[1:]))
