"""Random rotations of an ensemble about its mean, which change neither mean nor covariance."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, lru_cache

from filters.engine.belief import Kernels
from filters.engine.layout import memory_places
from thruster_env.core.compiled import inlined
from thruster_env.core.streams import FILTER_ROTATION, fill_normals


@inlined
def reflect(table, rows, first, size, vector):
    """Reflect each of the first `rows` rows x in the plane normal to v: x -= 2 (x'v / v'v) v.

    v has the entries vector[first] ... vector[size - 1] at their places, and zeros before.
    """
    square = 0.0
    for j in range(first, size):
        square += vector[j] * vector[j]
    for i in range(rows):
        product = 0.0
        for j in range(first, size):
            product += table[i, j] * vector[j]
        factor = 2.0 * product / square
        for j in range(first, size):
            table[i, j] -= factor * vector[j]


@cache
def rotator(n: int, m: int) -> Callable:
    """Return `rotate(memory, size)`: X = X W for members X (n, N), W random and orthogonal with W 1 = 1.

    In the basis whose first axis is (1, ..., 1)/N^1/2, to which one reflection leads and from which it leads back,
    W is 1 on that axis, and on the other N - 1 a product of reflections in random directions of ever fewer of
    them, with a random sign at the end: uniform among all rotations and reflections.

    Source: Stewart (1980), "The efficient generation of random orthogonal matrices with an application to
    condition estimators"; for ensembles: Sakov, Oke (2008), "Implications of the form of the ensemble
    transformation in the ensemble square root filters".
    """
    places = memory_places(n, m)
    step_place, key_0, key_1 = places.step, places.key_0, places.key_1

    @inlined
    def rotate(memory, size):
        row, table, draws = memory
        root = size**0.5
        # To the basis and back: v = (1, ..., 1)/N^1/2 - (1, 0, ..., 0).
        for turn in range(2):
            for j in range(size):
                draws[j] = 1.0 / root
            draws[0] -= 1.0
            reflect(table, n, 0, size, draws)
            if turn == 0:
                for first in range(1, size - 1):
                    # One counter for each vector of each step.
                    count = row[step_place] * size + first
                    fill_normals(draws, size, count, FILTER_ROTATION, row[key_0], row[key_1])
                    norm = 0.0
                    for j in range(first, size):
                        norm += draws[j] * draws[j]
                    # The reflection that takes this random vector to its first axis is the one in v + |v| e.
                    draws[first] += norm**0.5 if draws[first] >= 0.0 else -(norm**0.5)
                    reflect(table, n, first, size, draws)
                fill_normals(draws, size, row[step_place] * size, FILTER_ROTATION, row[key_0], row[key_1])
                for j in range(1, size):
                    if draws[j] < 0.0:
                        for i in range(n):
                            table[i, j] = -table[i, j]

    return rotate


@lru_cache(maxsize=64)
def with_rotation(kernels: Kernels) -> Kernels:
    """An ensemble's kernels with a random rotation after each update; mean and covariance stay."""
    rotate, update_plainly = rotator(kernels.n, kernels.m), kernels.update

    @inlined
    def update(memory, z, numbers, size):
        update_plainly(memory, z, numbers, size)
        rotate(memory, size)

    return kernels._replace(update=update)
