"""The geometric mean of two covariances."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache

import numpy as np

from filters.algebra.matrices import Operation, operation, same
from filters.algebra.operations import factor, mirrored, quotient
from thruster_env.core import matrices
from thruster_env.core.compiled import inlined
from thruster_env.core.sources import Source, entrywise, is_array, matrix_reader, matrix_writer
from thruster_env.graphs.graphs import Graph, called
from thruster_env.graphs.programs import CALLED, CALLED_IN_ROUNDS, Place, Program, program_of

ROUNDS = 14  # enough for condition numbers of 1e16: the last rounds each double the number of correct digits
CLOSE = 1e-10  # if det((a + b)/2)^(1/size), which is at least 1, exceeds 1 by less, one more round is enough


@operation(same, lambda a, b: True)
def geometric_mean(a, b):
    """A # B = A (A^-1 B)^(1/2) of two covariances, itself a covariance.

    Replacing the two by their arithmetic and harmonic mean, again and again, converges to it. With both scaled to
    determinant 1 one round is enough for two channels, and one channel needs none. For more than two channels
    programs call a function.

    Source: Bhatia (2007), Positive Definite Matrices, chapter 4; scaling by determinants: Higham (2008), Functions
    of Matrices, section 6.5.
    """
    size = len(a)
    if a.dtype == object and size > 2:
        numbers = [a[0, 0].graph.number(entry) for entry in (*a.ravel(), *b.ravel())]
        entries = called(_taught(size), size * size, *numbers)
        return mirrored.compute(np.array(entries, dtype=object).reshape(size, size))
    if size == 1:
        return np.array([[(a[0, 0] * b[0, 0]) ** 0.5]])
    a, b, unit = _scaled(a, b)
    for _ in range(rounds(size)):
        a, b = _closer(a, b)
    return a * unit


def _scaled(a, b):
    """Both with determinant 1, and the factor of their mean."""
    unit_a, unit_b = _unit(factor(a)), _unit(factor(b))
    return a * (1.0 / unit_a), b * (1.0 / unit_b), (unit_a * unit_b) ** 0.5


def _closer(a, b):
    """One round: arithmetic and harmonic mean, both with determinant 1."""
    both = a + b
    of = factor(both)
    parallel = mirrored(quotient(a, of) @ b)  # (a^-1 + b^-1)^-1
    unit = _unit(of)
    return both * (1.0 / unit), parallel * unit


def rounds(size: int) -> int:
    """Number of rounds."""
    return 1 if size == 2 else ROUNDS


def _unit(of):
    return math.prod(of[1]) ** (1.0 / len(of[1]))


@cache
def geometric_mean_of(size: int) -> Callable:
    """Return `mean(a, b)`, `geometric_mean` for `calls`; for large matrices it stops as soon as both are close."""
    if size == 1:
        return entrywise("mean", "a, b", (1, 1), lambda i, j: "(a[0][0] * b[0][0]) ** 0.5", a=(1, 1), b=(1, 1))
    count, close = rounds(size), 1.0 + CLOSE if is_array(size, size) else 0.0  # small matrices do all rounds
    cholesky, solve = matrices.cholesky_factor(size), matrices.row_solver(size, size)
    times, add = matrices.multiplier(size, size, size), matrices.symmetric_sum(size)
    source = Source("unit", "l", l=(size, size))  # l l' over this has determinant 1
    unit = source.function(source.product(f"l[{i}][{i}] ** {2.0 / size!r}" for i in source.range(size)))
    scaled = entrywise("scaled", "a, f", (size, size), lambda i, j: f"f * a[{i}][{j}]", a=(size, size))

    @inlined
    def mean(a, b):
        unit_a, unit_b = unit(cholesky(a)), unit(cholesky(b))
        a, b = scaled(a, 1.0 / unit_a), scaled(b, 1.0 / unit_b)
        rounds_left = count
        while rounds_left > 0:
            rounds_left -= 1
            both = add(a, b)
            root = cholesky(both)
            parallel = times(solve(a, root), b)
            unit_both = unit(root)
            if 0.5 * unit_both < close:  # it is 1 for equal ones, else larger
                rounds_left = min(rounds_left, 1)
            a, b = scaled(both, 1.0 / unit_both), scaled(add(parallel, parallel), 0.5 * unit_both)
        return scaled(a, (unit_a * unit_b) ** 0.5)

    return mean


@cache
def _taught(size: int) -> str:
    """The name under which programs call the mean."""
    mean, name, write = geometric_mean_of(size), f"geometric_mean_{size}", matrix_writer(size, size, 0)
    first, second = (matrix_reader(size, size, at) for at in (0, size * size))

    @inlined
    def work(pair, result):
        write(result, mean(first(pair), second(pair)))

    CALLED[name], CALLED_IN_ROUNDS[name] = work, lambda: _as_programs(size)
    return name


def _as_programs(size: int) -> tuple[Program, Program, Program, int, int]:
    """The mean as programs, for `CALLED_IN_ROUNDS`; "kept" holds both matrices and the factor of the mean."""
    square = size * size

    def program(array: str, work: Callable, to: str) -> Program:
        graph = Graph()
        numbers = np.array(
            [graph.given(Place(array, k)) for k in range(2 * square + (array == "kept"))], dtype=object
        )
        a, b = (numbers[k * square : (k + 1) * square].reshape(size, size) for k in range(2))
        results = np.concatenate([np.ravel(array) for array in work(a, b, *numbers[2 * square :])])
        return program_of([(Place(to, k), graph.number(entry)) for k, entry in enumerate(results)], {})

    first, again = program("given", _scaled, "kept"), program("kept", lambda a, b, unit: _closer(a, b), "kept")
    last = program("kept", lambda a, b, unit: (a * unit,), "found")
    return first, again, last, rounds(size), 2 * square + 1


FUNCTIONS: dict[Operation, Callable] = {geometric_mean: lambda result, a, b: geometric_mean_of(a[0])}
