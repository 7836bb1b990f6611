"""An ensemble as a table with one column per member: its prior, its motion, its noise and its moments."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, lru_cache
from typing import NamedTuple

from filters.engine.layout import memory_places, row_access
from numerics import arrays
from numerics.angles import row_aligner
from numerics.compiled import inlined
from numerics.sources import Source
from numerics.streams import FILTER_PRIOR, FILTER_PROCESS, fill_normals
from numerics.tuples import column_reader, column_writer, vector_reader
from plants.layout import constants_reader, number_places
from plants.shape import Shape


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


@cache
def drawer(n: int, m: int) -> Callable:
    """Return `draw(draws, count, row, stream)`: fill draws with a stream's normals of the belief's step."""
    places = memory_places(n, m)
    step_place, key_0, key_1 = places.step, places.key_0, places.key_1

    @inlined
    def draw(draws, count, row, stream):
        fill_normals(draws, count, row[step_place], stream, row[key_0], row[key_1])

    return draw


@inlined
def centre(draws, count, width, size):
    """Give each of `count` rows of draws, of `width` each, the mean zero over the first N = `size` of its entries.

    The rest is scaled by (N/(N - 1))^1/2, so that the variance stays 1.
    """
    factor = (size / (size - 1.0)) ** 0.5
    for i in range(count):
        mean = 0.0
        for j in range(size):
            mean += draws[i * width + j]
        mean /= size
        for j in range(size):
            draws[i * width + j] = factor * (draws[i * width + j] - mean)


@cache
def row_means(rows: int) -> Callable:
    """Return `means(table, size)`: means of the first `size` entries of rows 0 ... rows - 1, in one loop."""
    source = Source("means", "table, size", result=(rows,))
    totals = source.totals("size", rows, lambda i: f"table[{i}, j]")
    return source.function(source.vector(rows, lambda i: f"{totals[i]} / size"))


@cache
def row_covariances(first: int, rows: int, second: int, columns: int) -> Callable:
    """Return `covariances(table, size, means)`: sample covariances of two groups of rows, in one loop.

    Entry (i, j) belongs to rows first + i and second + j; means are those of `row_means`, the divisor is size - 1.
    """
    last = max(first + rows, second + columns)
    source = Source("covariances", "table, size, means", result=(rows, columns), means=(last,))
    if source.loops:
        source.line(f"a = deviations(table, {first}, {rows}, {source.array_of('means')}[{first}:], size)")
        source.line(f"b = deviations(table, {second}, {columns}, {source.array_of('means')}[{second}:], size)")
        source.line("sums = product_of_rows(a, b)" if first != second else "sums = square_of_rows(a)")
        result = source.matrix(rows, columns, lambda i, j: f"sums[{i}, {j}] / (size - 1)")
        names = {"deviations": arrays.deviations, "product_of_rows": arrays.product_of_rows}
        return source.function(result, square_of_rows=arrays.square_of_rows, **names)
    pairs = [(i, j) for i in range(rows) for j in range(columns) if first != second or j <= i]
    used = sorted({first + i for i, _ in pairs} | {second + j for _, j in pairs})
    each = (f"d{k} = table[{k}, j] - means[{k}]" for k in used)
    totals = source.totals("size", pairs, lambda i, j: f"d{first + i} * d{second + j}", each)

    def entry(i, j):
        return f"{totals[i, j] if (i, j) in pairs else totals[j, i]} / (size - 1)"

    return source.function(source.matrix(rows, columns, entry))


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
    summarise: Callable  # summarise(memory, size): the belief's mean and covariance from the members


@lru_cache(maxsize=64)
def ensemble_motion(transition: Callable, shape: Shape) -> Motion:
    """Prior, motion x_j = f(x_j, u) + w_j with w_j ~ N(0, Q), and moments of an ensemble."""
    n, m = shape.n, shape.m
    places, source = memory_places(n, m), number_places(n, m)
    prior_mean_place, prior_root_place = source.prior_mean, source.prior_root
    q_root_place, substeps_place, step_place = source.q_root, source.substeps, places.step
    means_of_members, covariances_of_members = row_means(n), row_covariances(0, n, 0, n)
    _, (store_mean, store_cov), _ = row_access(shape)
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

    @inlined
    def summarise(memory, size):
        row, table, _ = memory
        means = means_of_members(table, size)
        store_mean(row, means)
        store_cov(row, covariances_of_members(table, size, means))

    return Motion(start, predict, summarise)
