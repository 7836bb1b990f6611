"""A page as kernels of the engine: what it says of matrices, worked out in the memory of a belief."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, lru_cache, partial
from math import prod

from filters.engine.belief import Kernels
from filters.engine.layout import memory_places, row_access
from filters.pages.equations import PagedModel
from filters.pages.memory import RowMemory
from filters.pages.page import Page
from filters.pages.programs import programs_of, stored, together
from filters.pages.stages import Stage
from thruster_env.core.compiled import inlined
from thruster_env.core.tuples import matrix_reader, vector_reader
from thruster_env.model.layout import number_places
from thruster_env.model.shape import Functions, Shape


def stages_of(page: Page, memory: RowMemory, model: PagedModel) -> list[Stage]:
    """What a page stores: at the start, where a prediction begins, in each substep, at its end, in an update."""
    places, x, p = memory_places(memory.shape.n, memory.shape.m), memory.x, memory.P
    started = page.started(model)
    model.kept = memory.keep(started)
    begun = (x, p) if page.begin is None else together(page.begin(model, x, p))
    flying = (x, p) if page.begin is None else [memory.another(one) for one in begun]
    advanced = together(page.advance(model, *flying, memory.u))
    told = places.innovation, places.innovation_cov, places.log_likelihood
    return [
        stored((started,), (), memory.kept),
        Stage({}, {}) if page.begin is None else stored(begun, flying),
        stored(advanced, flying, memory.kept),
        stored(page.settle(model, *flying), (x, p), memory.kept),
        stored(page.update(model, x, p, memory.z), (x, p, *told), memory.kept),
    ]


@lru_cache(maxsize=64)
def page_kernels(page: Page, functions: Functions, shape: Shape) -> Kernels:
    """Kernels of a page for a model's functions and shape."""
    n, m = shape.n, shape.m
    memory, works, vectors = programs_of(page, functions, shape, partial(stages_of, page))
    start, begin, advance, settle, correct = works
    places, kept = memory_places(n, m), sum(prod(one.shape) for one in memory.kept.values())
    prior, step_place, substeps_place = prior_start(shape), places.step, number_places(n, m).substeps

    @inlined
    def begin_belief(memory, numbers, size):
        prior(memory, numbers, size)
        start(memory[0], numbers, numbers)

    @inlined
    def predict(memory, u, numbers, size):
        row, _, _ = memory
        begin(row, u, numbers)
        for _ in range(int(numbers[substeps_place])):
            advance(row, u, numbers)
        settle(row, u, numbers)
        row[step_place] += 1.0

    @inlined
    def update(memory, z, numbers, size):
        correct(memory[0], z, numbers)

    return Kernels(
        *(n, m, n, 0, begin_belief, predict, update, nothing_to_summarise),
        extras=kept,
        scratch=memory.end - places.extras - kept,
        vectors=vectors[1:],
    )


@cache
def prior_start(shape: Shape) -> Callable:
    """Return `start(memory, numbers, size)`: mean and covariance are those of the prior."""
    n, m = shape.n, shape.m
    source = number_places(n, m)
    read_mean, read_cov = vector_reader(n, source.prior_mean), matrix_reader(n, n, source.prior_cov)
    _, (store_mean, store_cov), _ = row_access(shape)

    @inlined
    def start(memory, numbers, size):
        row, _, _ = memory
        store_mean(row, read_mean(numbers))
        store_cov(row, read_cov(numbers))

    return start


@inlined
def nothing_to_summarise(memory, size):
    """Mean and covariance are the belief itself."""


@inlined
def anything_measured(z):
    """Whether a channel of z is present."""
    for i in range(z.shape[0]):
        if z[i] == z[i]:
            return True
    return False
