"""Particles as a table with one column for each: their prior, their motion and its noise, angles on one branch."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, lru_cache
from typing import NamedTuple

from filters.engine.layout import memory_places
from thruster_env.numerics.angles import row_aligner
from thruster_env.numerics.compiled import inlined
from thruster_env.numerics.streams import FILTER_PRIOR, FILTER_PROCESS, fill_normals
from thruster_env.numerics.tuples import column_reader, column_writer, vector_reader
from thruster_env.plants.layout import constants_reader, number_places
from thruster_env.plants.shape import Shape


@inlined
def add_noise(table, first, count, draws, numbers, root):
    """Rows first ... += L W, where the lower triangular L lies at numbers[root] and W, by rows, in draws."""
    width = table.shape[1]
    for i in range(count):
        for k in range(i + 1):
            factor = numbers[root + i * count + k]
            if factor != 0.0:
                for j in range(width):
                    table[first + i, j] += factor * draws[k * width + j]


@inlined
def clear_noise(table, first, count):
    """Rows first ... become zero."""
    for i in range(count):
        for j in range(table.shape[1]):
            table[first + i, j] = 0.0


@cache
def drawer(n: int, m: int) -> Callable:
    """Return `draw(draws, count, row, stream)`: fill draws with a stream's normals of the belief's step."""
    places = memory_places(n, m)
    step_place, key_0, key_1 = places.step, places.key_0, places.key_1

    @inlined
    def draw(draws, count, row, stream):
        fill_normals(draws, count, row[step_place], stream, row[key_0], row[key_1])

    return draw


@cache
def silencer(first: int, angles: tuple[bool, ...], weights: int | None = None) -> Callable:
    """Return `silence(table, z, size)`, for rows first, first + 1, ... of what the members expect to be measured.

    They become 0 where z is NaN: a constant has no covariance with anything. Angles are put on one branch.
    """

    @inlined
    def silence(table, z, size):
        for i in range(z.shape[0]):
            if z[i] != z[i]:
                for j in range(table.shape[1]):
                    table[first + i, j] = 0.0

    if not any(angles):
        return silence
    align = row_aligner(first, angles, weights)

    @inlined
    def silence_and_align(table, z, size):
        silence(table, z, size)
        align(table, size)

    return silence_and_align


def _aligned(start: Callable, predict: Callable, align: Callable) -> tuple[Callable, Callable]:
    """Both, with states that are angles put on one branch at the end; updates then move the members as numbers."""

    @inlined
    def start_aligned(memory, numbers, size):
        start(memory, numbers, size)
        align(memory[1], size)

    @inlined
    def predict_aligned(memory, u, numbers, size):
        predict(memory, u, numbers, size)
        align(memory[1], size)

    return start_aligned, predict_aligned


class Motion(NamedTuple):
    """Functions common to all ensembles, for one shape of model."""

    start: Callable  # start(memory, numbers, size): members drawn from the prior
    predict: Callable  # predict(memory, u, numbers, size): members moved, then process noise added


@lru_cache(maxsize=64)
def ensemble_motion(transition: Callable, shape: Shape) -> Motion:
    """Prior, motion x_j = f(x_j, u) + w_j with w_j ~ N(0, Q), and moments of an ensemble."""
    n, m = shape.n, shape.m
    places, source = memory_places(n, m), number_places(n, m)
    prior_mean_place, prior_root_place = source.prior_mean, source.prior_root
    q_root_place, substeps_place, step_place = source.q_root, source.substeps, places.step
    constants, control = constants_reader(shape), vector_reader(shape.inputs)
    state, store_state, draw = column_reader(n), column_writer(n), drawer(n, m)

    @inlined
    def start(memory, numbers, size):
        row, table, draws = memory
        draw(draws, n * table.shape[1], row, FILTER_PRIOR)
        for i in range(n):
            for j in range(table.shape[1]):
                table[i, j] = numbers[prior_mean_place + i]
        add_noise(table, 0, n, draws, numbers, prior_root_place)

    @inlined
    def predict(memory, u, numbers, size):
        row, table, draws = memory
        v, c = control(u), constants(numbers)
        for _ in range(int(numbers[substeps_place])):
            for j in range(table.shape[1]):
                store_state(table, j, transition(state(table, j), v, c))
        row[step_place] += 1.0
        draw(draws, n * table.shape[1], row, FILTER_PROCESS)
        add_noise(table, 0, n, draws, numbers, q_root_place)

    if any(shape.state_angles):
        start, predict = _aligned(start, predict, row_aligner(0, shape.state_angles))

    return Motion(start, predict)
