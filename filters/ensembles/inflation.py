"""Inflation of an ensemble's spread by a factor a step, and relaxation to the spread before an update."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, lru_cache

from filters.engine.belief import Kernels
from filters.engine.layout import memory_places, own_place
from filters.ensembles.members import row_covariances, row_means
from numerics.compiled import inlined
from numerics.sources import Source, entrywise
from numerics.tuples import vector_reader
from plants.shape import Shape


@cache
def spread_scaler(n: int) -> Callable:
    """Return `scale(table, means, factors)`: x_a = mean_a + factor_a (x_a - mean_a) in rows a = 0 ... n - 1."""
    source = Source("scale", "table, means, factors", means=(n,), factors=(n,))
    for a in source.rows_of_members(n):
        source.line(f"table[{a}, j] = means[{a}] + factors[{a}] * (table[{a}, j] - means[{a}])")
    return source.function()


@lru_cache(maxsize=64)
def with_spread_control(kernels: Kernels, shape: Shape) -> Kernels:
    """An ensemble's kernels with inflation and relaxation, by the first two of the filter's own numbers.

        predict: ..., then x_j = mean + inflation (x_j - mean)
        update:  ..., then x_j = mean + (1 + relaxation (b - a)/a) (x_j - mean), by components, where b and a are
                 the sample standard deviations before and after the update

    Where a component has no spread after the update, it keeps none. The means stay.
    """
    n, m, summarise = kernels.n, kernels.m, kernels.summarise
    predict_plainly, update_plainly, cov_place = kernels.predict, kernels.update, memory_places(n, m).cov
    inflation_place = own_place(shape)
    relaxation_place = inflation_place + 1
    means_of, covariances_of, scale = row_means(n), row_covariances(0, n, 0, n), spread_scaler(n)
    read_mean = vector_reader(n, memory_places(n, m).mean)

    @inlined
    def centre_as_kept(row, table, size):
        return read_mean(row)

    @inlined
    def centre_on_the_branch(row, table, size):
        return means_of(table, size)

    centre = centre_on_the_branch if any(shape.state_angles) else centre_as_kept
    variances = entrywise("variances", "row", (n,), lambda i: f"row[{i * (n + 1) + cov_place}]")
    diagonal = entrywise("diagonal", "p", (n,), lambda i: f"p[{i}][{i}]", p=(n, n))
    alike = entrywise("alike", "factor", (n,), lambda i: "factor")
    towards = entrywise(
        "towards",
        "a, b, part",
        (n,),
        lambda i: f"1.0 + part * ((b[{i}] / a[{i}]) ** 0.5 - 1.0) if a[{i}] > 0.0 else 1.0",
        a=(n,),
        b=(n,),
    )

    @inlined
    def predict(memory, u, numbers, size):
        predict_plainly(memory, u, numbers, size)
        _, table, _ = memory
        scale(table, means_of(table, size), alike(numbers[inflation_place]))

    @inlined
    def update(memory, z, numbers, size):
        row, table, _ = memory
        before = diagonal(covariances_of(table, size, means_of(table, size)))
        update_plainly(memory, z, numbers, size)
        if numbers[relaxation_place] != 0.0:
            scale(table, centre(row, table, size), towards(variances(row), before, numbers[relaxation_place]))
            summarise(memory, size)

    return kernels._replace(predict=predict, update=update)
