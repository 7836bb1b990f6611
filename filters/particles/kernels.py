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
from math import prod

from filters.engine.belief import Kernels
from filters.engine.layout import memory_places, own_place
from filters.pages.equations import PagedModel
from filters.pages.kernels import anything_measured
from filters.pages.members import MembersMemory, works_of
from filters.pages.page import Page
from filters.pages.programs import stored, with_kept
from filters.pages.stages import Stage
from filters.particles.resampling import SCRATCH_ROWS, systematic_resampler
from thruster_env.numerics.algebra.matrices import Matrix, given
from thruster_env.numerics.algebra.members import on_branch
from thruster_env.numerics.algebra.operations import wrap
from thruster_env.numerics.algebra.programs import Place
from thruster_env.numerics.algebra.samples import (
    effective_size,
    normalised,
    weighted_covariance,
    weighted_mean,
    weights,
)
from thruster_env.numerics.compiled import inlined
from thruster_env.numerics.streams import (
    FILTER_KERNEL,
    FILTER_MEASUREMENT,
    FILTER_PRIOR,
    FILTER_PROCESS,
    FILTER_PROPOSAL,
    fill_normals,
    uniform_block,
)
from thruster_env.plants.layout import number_places
from thruster_env.plants.shape import Functions, Shape


class Layout:
    """Where everything lies.

    Attributes:
        x, logarithm, weight: rows of the table, of which the weights are scratch, and lie behind what is kept.
        kept: what is kept besides, in the table or the row.
        size: the place of the ESS.
        rows, extras: how many rows of the table and numbers of the row belong to the belief.
    """

    def __init__(self, page: Page, memory: MembersMemory, model: PagedModel):
        """Give each its place."""
        n, first = memory.shape.n, memory_places(memory.shape.n, memory.shape.m).extras
        self.x, self.logarithm = memory.x, given(Place("table", n), (), member=True, like=memory.x)
        self.size, self.kept = Place("rows", first), {}
        ends = {"table": n + 1, "rows": first + 1}
        self.start = with_kept(page.start(model, memory.w))  # type: ignore[misc]
        for name, one in self.start[-1].items():
            array, member = ("table", True) if name in page.of_each else ("rows", False)
            place = Place(array, ends[array])
            self.kept[name] = given(place, one.shape, symmetric=one.symmetric, member=member, like=memory.x)
            ends[array] += prod(one.shape)
        self.rows, self.extras, self.weight = ends["table"], ends["rows"] - first, Place("table", ends["table"])
        model.kept = self.kept

    def moments(self, model: PagedModel, x: Matrix, w: Matrix, P: Matrix | None) -> tuple[Matrix, ...]:
        """Particles with their angles on one branch, their mean and their covariance."""
        x = on_branch(x, model.state_angles, w)
        cov = weighted_covariance(x, w)
        return x, wrap(weighted_mean(x, w), model.state_angles), cov if P is None else cov + weighted_mean(P, w)


def stages_of(page: Page, memory: MembersMemory, model: PagedModel) -> dict[str, Stage]:
    """What a page stores; the stages are named in `particle_kernels`."""
    at = Layout(page, memory, model)
    x, log_w, kept = at.x, at.logarithm, at.kept
    innovation, cov, likelihood = memory.told
    found = {
        "advance": page.advance(model, x, memory.u),
        "settle": page.settle(model, x, memory.w),
    }
    stages = {
        "start": stored((on_branch(at.start[0], model.state_angles), *at.start[1:]), (x,), kept),
        "choose": stored((weights(log_w),), (at.weight,)),
        "summarise": stored(at.moments(model, x, weights(log_w), kept.get("P")), (x, *memory.belief)),
        **{name: stored(results, (x,), kept) for name, results in found.items()},
    }
    if page.renew:
        stages["renew"] = stored(page.renew(model, x, memory.mean, memory.P, memory.w), (x,), kept)
    if page.foresee:
        mu, level, v, S = page.foresee(model, x, log_w, memory.z)
        w, first = normalised(log_w + level)
        chosen = (at.moments(model, mu, w, None)[1:], memory.belief) if page.renew else ((), ())
        places = (x, log_w, innovation, cov, at.weight, likelihood, *chosen[1])
        stages["foresee"] = stored((mu, -level, v, S, w, first, *chosen[0]), places)
        log_w = log_w + memory.read("rows", likelihood.at)
    x, log_w, *told, changed = with_kept(page.update(model, x, log_w, memory.z, memory.e))
    w, level = normalised(log_w)
    x, *moments = at.moments(model, x, w, changed.get("P"))
    results = x, log_w - level, level, effective_size(w), *moments, *told, changed
    places = at.x, at.logarithm, likelihood, at.size, *memory.belief, *(innovation, cov)[: len(told)]
    return {**stages, "update": stored(results, places, kept)}


@lru_cache(maxsize=64)
def particle_kernels(page: Page, functions: Functions, shape: Shape, resample: bool = True) -> Kernels:
    """Kernels of a particle filter's page for a model's functions and shape.

    If they do not resample, a page's `renew` draws all particles anew.
    """
    n, m, memory = shape.n, shape.m, MembersMemory(shape, page)
    layout = Layout(page, memory, PagedModel(memory))
    works = works_of(page, functions, shape, stages_of, layout.rows + 1)
    places, source, scratch = memory_places(n, m), number_places(n, m), layout.rows + 1
    step, key_0, key_1, likelihood = places.step, places.key_0, places.key_1, places.log_likelihood
    innovation, cov, r_place, mean_place = places.innovation, places.innovation_cov, source.r, places.mean
    logarithm, size_place, substeps_place = n, layout.size.at, source.substeps
    threshold = page.places(own_place(shape)).get("resampling_threshold", 0)
    move = systematic_resampler(n + 1 if page.foresee else layout.rows, layout.weight.at, scratch)
    (begin, drawn), (settle, moved), (correct, proposed) = (
        (works[name].work, works[name].draws) for name in ("start", "settle", "update")
    )
    advance, choose, moments = (works[name].work for name in ("advance", "choose", "summarise"))

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

        @inlined
        def chosen_anew(memory, numbers, size):
            row, table, draws = memory
            choose_first(memory, numbers, size)
            draw(memory, spread, FILTER_KERNEL)
            renew(row, row, numbers, table, draws, size)

    @inlined
    def predict(memory, u, numbers, size):
        row, table, draws = memory
        for _ in range(int(numbers[substeps_place])):
            advance(row, u, numbers, table, draws, size)
        row[step] += 1.0
        draw(memory, moved, FILTER_PROCESS)
        settle(row, u, numbers, table, draws, size)

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

    @inlined
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
