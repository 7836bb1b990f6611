"""The arithmetic limit of the machine at hand: how fast it does each kind of operation, measured in this run.

Each rate is that of a loop in the widest vectors, in the fastest cache, whose operations depend on one another too
little to wait and too much to be dropped. The limit of a computation is the time of its operations, one kind after
the other: that of a program without memory, calls, branches or remainders, and of no other program.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from functools import cache
from time import perf_counter
from typing import NamedTuple

import numpy as np

from benchmarks.counting import ADD, DIVIDE, INTEGER, MULTIPLY, PRODUCT, RECIPROCAL_ROOT, ROOT
from thruster_env.core.compiled import compiled
from thruster_env.core.threads import cores as all_cores
from thruster_env.core.threads import spread

FUSED, ROUND = "fused multiply-add", "product, shift and two exclusive ors"
IN_A_ROUND = 3  # operations on whole numbers that go with a product in a round of Philox
WIDTH, REPEATS, ROUNDS = 1024, 500, 15
PARTS = 8  # of the work on all cores

_MULTIPLIER_0, _MULTIPLIER_1 = np.uint64(0xD2511F53), np.uint64(0xCD9E8D57)
_LOW, _SHIFT, _WEYL = np.uint64(0xFFFFFFFF), np.uint64(32), np.uint64(0x9E3779B9)
_LEFT, _RIGHT, _FURTHER = np.uint64(13), np.uint64(7), np.uint64(17)
_START = 0x5FE6EB50C7B537A9  # minus half the bits of x is near the bits of x^-1/2


def arithmetic_limit(count: Counter[str], *, cores: int = 1) -> float:
    """Seconds that operations take on so many cores, each kind at its best measured rate.

    Additions and multiplications come in pairs, as far as they go: one instruction does both.
    """
    if not count:
        return 0.0
    rate = rates(cores)
    within_rounds = IN_A_ROUND * count[PRODUCT]
    return (
        max(count[ADD], count[MULTIPLY]) * rate[FUSED]
        + count[DIVIDE] * rate[DIVIDE]
        + count[ROOT] * rate[ROOT]
        + count[RECIPROCAL_ROOT] * rate[RECIPROCAL_ROOT]
        + count[PRODUCT] * rate[ROUND]
        + max(count[INTEGER] - within_rounds, 0.0) * rate[INTEGER]
    )


def _fused(data, repeats):
    for _ in range(repeats):
        for j in range(data.shape[0]):
            c = data[j]
            x, y, z, w = 0.9 * c, 0.8 * c, 0.7 * c, 0.6 * c
            for _ in range(16):
                x = x * x - c
                y = y * y - c
                z = z * z - c
                w = w * w - c
            data[j] = c + 1e-9 * (x * y + z * w)


def _divided(data, repeats):
    for _ in range(repeats):
        for j in range(data.shape[0]):
            data[j] = 1.0 / (data[j] + 1.0)


def _root(data, repeats):
    for _ in range(repeats):
        for j in range(data.shape[0]):
            data[j] = (data[j] + 1.0) ** 0.5


def _reciprocal_root(data, repeats):
    for _ in range(repeats):
        for j in range(data.shape[0]):
            data[j] = 1.0 / (data[j] + 1.0) ** 0.5


def _newtons_root(data, repeats):  # the same to 1e-15
    for _ in range(repeats):
        for j in range(data.shape[0]):
            x = data[j] + 1.0
            half = 0.5 * x
            y = np.int64(_START - (np.float64(x).view(np.int64) >> 1)).view(np.float64)
            for _ in range(4):
                y = y * (1.5 - half * y * y)
            data[j] = y


def _rounds(data, repeats):
    for _ in range(repeats):
        for j in range(data.shape[0]):
            c0 = c1 = c2 = c3 = data[j]
            for _ in range(10):
                product_0, product_1 = _MULTIPLIER_0 * (c0 & _LOW), _MULTIPLIER_1 * (c2 & _LOW)
                c0, c1 = (product_1 >> _SHIFT) ^ c1 ^ _WEYL, product_1 & _LOW
                c2, c3 = (product_0 >> _SHIFT) ^ c3 ^ _WEYL, product_0 & _LOW
            data[j] = c0 ^ c1 ^ c2 ^ c3


def _shifts(data, repeats):
    for _ in range(repeats):
        for j in range(data.shape[0]):
            x = data[j]
            for _ in range(8):
                x = x ^ (x << _LEFT)
                x = x ^ (x >> _RIGHT)
                x = x ^ (x << _FURTHER)
            data[j] = x


class Loop(NamedTuple):
    """A loop over data, and how often each of their entries meets the operation."""

    function: Callable  # function(data, repeats)
    count: int
    data: np.ndarray


_NUMBERS, _WORDS = np.linspace(1.0, 2.0, WIDTH), np.arange(WIDTH).astype(np.uint64) * np.uint64(77777)
LOOPS = {
    FUSED: [Loop(_fused, 71, -0.1 * _NUMBERS)],
    DIVIDE: [Loop(_divided, 1, _NUMBERS)],
    ROOT: [Loop(_root, 1, _NUMBERS)],
    RECIPROCAL_ROOT: [Loop(_reciprocal_root, 1, _NUMBERS), Loop(_newtons_root, 1, _NUMBERS)],
    ROUND: [Loop(_rounds, 20, _WORDS)],
    INTEGER: [Loop(_shifts, 48, _WORDS)],
}


@cache
def rates(cores: int) -> dict[str, float]:
    """Seconds an operation of each kind, on one core or on all; measured at the first call."""
    return _measured(cores)


def measure_again() -> None:
    """Measure the rates once more and keep the better ones: others may have used the machine before, or do now."""
    for cores in {1, all_cores()}:
        rates(cores).update({kind: min(rates(cores)[kind], rate) for kind, rate in _measured(cores).items()})


def _measured(cores: int) -> dict[str, float]:
    return {kind: min(_seconds(loop, cores) for loop in loops) for kind, loops in LOOPS.items()}


def _seconds(loop: Loop, cores: int) -> float:
    """The best of many rounds."""
    run = _compiled(loop.function)

    def part(first: int, last: int) -> None:
        for _ in range(first, last):
            run(loop.data.copy(), REPEATS)

    part(0, 1)
    best = np.inf
    for _ in range(ROUNDS):
        begin = perf_counter()
        if cores == 1:
            part(0, PARTS)
        else:
            spread(part, PARTS)
        best = min(best, perf_counter() - begin)
    return best / (PARTS * REPEATS * len(loop.data) * loop.count)


@cache
def _compiled(function: Callable) -> Callable:
    return compiled(function)


def vector_bits() -> int:
    """Bits in the vectors of which the compiler makes our loops, as its assembly shows."""
    from numba.core.caching import NullCache

    def scale(values):
        for j in range(values.shape[0]):
            values[j] *= 2.0

    run = compiled(scale)
    run._cache = NullCache()  # there is no assembly of code that was read from a file
    run(np.ones(1))
    (code,) = run.inspect_asm().values()
    return 512 if "%zmm" in code else 256 if "%ymm" in code else 128
