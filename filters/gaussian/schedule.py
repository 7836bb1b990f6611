"""A Kalman filter whose affine model follows the input: gain scheduling."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, lru_cache

import numpy as np

from filters.engine.belief import Kernels
from filters.engine.layout import memory_places, own_place, row_access
from filters.gaussian.extended import (
    gaussian_correction,
    gaussian_start,
    in_stages,
    noise_added,
    nothing_to_summarise,
)
from numerics.compiled import inlined
from numerics.matrices import multiplier, transposed_multiplier
from numerics.sources import tuple_of, written_out
from numerics.tuples import matrix_reader, vector_reader
from plants.affine import affine_functions
from plants.layout import affine_constants, number_places
from plants.shape import Shape, constants_are_array


@cache
def interpolator(points: int, count: int, first: int) -> Callable:
    """Return `blend(numbers, u)`: `count` constants, linear in u between points and constant beyond them.

    At numbers[first] lie the inputs of the points, increasing, then the constants of each point.
    """
    inputs = [f"numbers[{first + s}]" for s in range(points)]
    lines = []
    for s in range(points):
        sides = []
        if s > 0:
            sides.append(f"(u - {inputs[s - 1]}) / ({inputs[s]} - {inputs[s - 1]})")
        if s < points - 1:
            sides.append(f"({inputs[s + 1]} - u) / ({inputs[s + 1]} - {inputs[s]})")
        lines.append(f"w{s} = max(0.0, min(1.0, {', '.join(sides)}))")
    table = first + points
    if constants_are_array(count):
        weights = f"weights = np.array({tuple_of(f'w{s}' for s in range(points))})"
        loops = f"for s in range({points}):", f"    for i in range({count}):"
        add = f"        c[i] += weights[s] * numbers[{table} + s * {count} + i]"
        return written_out(
            "blend", "numbers, u", *lines, weights, f"c = np.zeros({count})", *loops, add, "c", np=np
        )
    sums = (" + ".join(f"w{s} * numbers[{table + s * count + i}]" for s in range(points)) for i in range(count))
    return written_out("blend", "numbers, u", *lines, tuple_of(sums))


@lru_cache(maxsize=64)
def scheduled_kernels(points: int, shape: Shape) -> Kernels:
    """Kernels of the Kalman filter on affine models at several inputs (p = 1), one after the other in its numbers.

    The extras are the constants of the model in use, which those of the last input are until the next.
    """
    n, m, count = shape.n, shape.m, shape.constants
    places, source = memory_places(n, m), number_places(n, m)
    transition, observe, transition_matrix, observation_matrix = affine_functions(n, m, 1).values()
    blend = interpolator(points, count, own_place(shape))
    read_constants, store_constants = affine_constants(count, places.extras)
    (read_mean, read_cov), (store_mean, store_cov), _ = row_access(shape)
    read_q, read_r, measured = matrix_reader(n, n, source.q), matrix_reader(m, m, source.r), vector_reader(m)
    times, times_transposed, control = multiplier(n, n, n), transposed_multiplier(n, n, n), vector_reader(1)
    start_gaussian, settle, correct = gaussian_start(shape), noise_added(n, m), gaussian_correction(shape)

    @inlined
    def start(memory, numbers, size):
        start_gaussian(memory, numbers, size)
        store_constants(memory[0], blend(numbers, 0.0))

    @inlined
    def begin(memory, u, numbers, size):
        store_constants(memory[0], blend(numbers, u[0]))

    @inlined
    def advance(memory, u, numbers, size):
        row, _, _ = memory
        mean, c, v = read_mean(row), read_constants(row), control(u)
        f = transition_matrix(mean, v, c)
        store_mean(row, transition(mean, v, c))
        store_cov(row, times_transposed(times(f, read_cov(row)), f))

    @inlined
    def finish(memory, u, numbers, size):
        settle(memory[0], read_q(numbers))

    @inlined
    def update(memory, z, numbers, size):
        row, _, _ = memory
        mean, c = read_mean(row), read_constants(row)
        correct(row, measured(z), observe(mean, c), observation_matrix(mean, c), read_r(numbers))

    stages = begin, advance, finish
    predict = in_stages(n, m, *stages)
    return Kernels(n, m, n, 0, start, predict, update, nothing_to_summarise, extras=count, stages=stages)
