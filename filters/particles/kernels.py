"""A page of a particle filter as kernels of the engine: what it says of a particle is done for each of them.

    x, kept = start(model, w),  w ~ N(0, I)
    if the ESS is below its threshold: particles are resampled,  x, kept = renew(model, x, mean, P, e)
    x, kept = settle(model, advance(model, x, u), w), advance once for each of the model's substeps
    x, log_w, v, S, kept = update(model, x, log_w, z, e),  log_w the logarithms of the weights,  e ~ N(0, I)

`kept` is a dictionary of what is kept besides x and log_w, and is left out where nothing is; a `P` is the
covariance of a particle. The sum of e^log_w after an update is the likelihood, by which weights are then divided.
A page with a `foresee` has particles resampled in the update, by the weights log_w + level:

    mu, level, v, S = foresee(model, x, log_w, z),  mu is renewed with its own mean and P,
    x, log_w, kept = update(model, mu, log_w, z, e),  log_w the logarithm of the sum of those weights, less that of
                                                      N and less the level
"""

from __future__ import annotations

import math
from functools import lru_cache

from filters.engine.belief import Kernels
from filters.engine.layout import memory_places, own_place
from filters.pages.equations import PagedModel
from filters.pages.kernels import anything_measured
from filters.pages.members import MembersMemory, predictor, works_of
from filters.pages.page import Page
from filters.particles.resampling import SCRATCH_ROWS, systematic_resampler
from filters.particles.stages import Layout, stages_of
from thruster_env.core.compiled import inlined, not_inlined
from thruster_env.core.streams import (
    FILTER_KERNEL,
    FILTER_MEASUREMENT,
    FILTER_PRIOR,
    FILTER_PROPOSAL,
    fill_normals,
    uniform_block,
)
from thruster_env.model.layout import number_places
from thruster_env.model.shape import Functions, Shape


@lru_cache(maxsize=64)
def particle_kernels(page: Page, functions: Functions, shape: Shape, resample: bool = True) -> Kernels:
    """Kernels of a particle filter's page for a model's functions and shape.

    If they do not resample, a page's `renew` draws all particles anew. What sums over particles is not inlined, so
    that single steps and batches, which would round otherwise, agree to the last bit.
    """
    n, m, memory = shape.n, shape.m, MembersMemory(shape, page)
    layout = Layout(page, memory, PagedModel(memory))
    works = works_of(page, functions, shape, stages_of, layout.rows + 1)
    places, source, scratch = memory_places(n, m), number_places(n, m), layout.rows + 1
    step, key_0, key_1, likelihood = places.step, places.key_0, places.key_1, places.log_likelihood
    innovation, cov, r_place, mean_place = places.innovation, places.innovation_cov, source.r, places.mean
    logarithm, size_place = n, layout.size.at
    threshold = page.places(own_place(shape)).get("resampling_threshold", 0)
    move = systematic_resampler(n + 1 if page.foresee else layout.rows, layout.weight.at, scratch)
    (begin, _, drawn), (correct, _, proposed) = works["start"], works["update"]
    choose, moments, predict = works["choose"].work, works["summarise"].work, predictor(works, shape)

    @inlined
    def draw(memory, count, stream):
        row, table, draws = memory
        fill_normals(draws, count * table.shape[1], row[step], stream, row[key_0], row[key_1])

    @inlined
    def set_equal(memory, size):
        row, table, _ = memory
        for j in range(table.shape[1]):
            table[logarithm, j] = -math.log(size)
        row[size_place] = size

    @inlined
    def start(memory, numbers, size):
        row, table, draws = memory
        draw(memory, drawn, FILTER_PRIOR)
        begin(row, numbers, numbers, table, draws, size)
        set_equal(memory, size)

    @inlined
    def resampled(memory, numbers, size):
        row, table, _ = memory
        place, _, _, _ = uniform_block(0, row[step], FILTER_MEASUREMENT, row[key_0], row[key_1])
        move(table, size, place)

    @inlined
    def chosen(memory, numbers, size):
        row, table, draws = memory
        choose(row, row, numbers, table, draws, size)
        resampled(memory, numbers, size)

    chosen_anew = resampled if page.foresee else chosen
    if page.renew:
        renew, spread = works["renew"].work, works["renew"].draws
        choose_first = chosen_anew if resample else nothing

        @not_inlined
        def chosen_anew(memory, numbers, size):
            row, table, draws = memory
            choose_first(memory, numbers, size)
            draw(memory, spread, FILTER_KERNEL)
            renew(row, row, numbers, table, draws, size)

    @inlined
    def predict_chosen(memory, u, numbers, size):
        row, _, _ = memory
        if row[size_place] < numbers[threshold] * size:
            chosen_anew(memory, numbers, size)
            set_equal(memory, size)
        predict(memory, u, numbers, size)

    @inlined
    def summarise(memory, size):
        row, table, draws = memory
        moments(row, row, row, table, draws, size)

    @inlined
    def tell_nothing(memory, numbers):
        row, _, _ = memory
        for i in range(m):
            row[innovation + i] = 0.0
            for k in range(m):
                row[cov + i * m + k] = numbers[r_place + i * m + k] if i == k else 0.0
        row[likelihood] = 0.0

    first = nothing_foreseen
    if page.foresee:
        foresee = works["foresee"].work

        @inlined
        def first(memory, z, numbers, size):
            row, table, draws = memory
            foresee(row, z, numbers, table, draws, size)
            chosen_anew(memory, numbers, size)
            row[likelihood] -= math.log(size)

    @not_inlined
    def update(memory, z, numbers, size):
        row, table, draws = memory
        if not anything_measured(z):
            tell_nothing(memory, numbers)
            summarise(memory, size)
            return
        first(memory, z, numbers, size)
        if proposed > 0:
            draw(memory, proposed, FILTER_PROPOSAL)
        correct(row, z, numbers, table, draws, size)
        if row[likelihood] != row[likelihood]:
            row[mean_place] = math.nan  # no particle explains z: the belief is lost

    rows = max(scratch + SCRATCH_ROWS, *(one.rows for one in works.values()))
    return Kernels(
        *(n, m, rows, max(n, m), start, predict if page.foresee else predict_chosen, update, summarise),
        extras=layout.extras,
        extra_kept_rows=layout.rows - n,
    )


@inlined
def nothing(memory, numbers, size):
    """In the place of resampling."""


@inlined
def nothing_foreseen(memory, z, numbers, size):
    """In the place of what pages foresee."""
