"""Particle filters in compiled code: stages of a page, and systematic resampling.

    x, extras = initial(model, w),  w ~ N(0, I)
    if the ESS is below its threshold: particles are resampled,
    x, extras = rejuvenate(model, x, mean, P, e)
    x, extras = add_process_noise(model, propagate(model, x, u), w),  propagate once for each substep
    x, log_w, v, S, extras = update(model, x, log_w, z, e),  log_w the logarithms of the weights,  e ~ N(0, I)

`extras` is a dictionary of all that a particle carries besides x and log_w, left out if there is nothing; its
`P` is the covariance of a particle. The sum of e^log_w after an update is the likelihood, by which weights are
then divided.
A page with a `lookahead` has particles resampled in the update, by the weights log_w + level:

    mu, level, v, S = lookahead(model, x, log_w, z),  mu is rejuvenated with its own mean and P,
    x, log_w, extras = update(model, mu, log_w, z, e),  log_w the logarithm of the sum of those weights, less that
                                                        of N and less the level
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache, lru_cache
from math import prod

from filters.algebra.matrices import Matrix, input_matrix
from filters.algebra.members import on_branch
from filters.algebra.operations import wrap
from filters.algebra.samples import effective_size, normalised, weighted_covariance, weighted_mean, weights
from filters.algebra.scalars import at_least
from filters.engine.belief import Kernels, memory_places, own_place
from filters.pages.equations import PagedModel
from filters.pages.kernels import Stage, anything_measured, stored, with_extras
from filters.pages.members import MembersMemory, predictor, works_of
from filters.pages.page import Page
from thruster_env.core.compiled import inlined, not_inlined
from thruster_env.core.streams import (
    FILTER_KERNEL,
    FILTER_MEASUREMENT,
    FILTER_PRIOR,
    FILTER_PROPOSAL,
    fill_normals,
    uniform_block,
)
from thruster_env.graphs.programs import Place
from thruster_env.model.shape import Functions, Shape, number_places

LOWEST = -1e300  # of logarithms of weights


class Layout:
    """The layout of a particle filter's memory.

    Attributes:
        x, logarithm, weight: rows of the table: particles, log weights, and weights, which are scratch.
        kept: the page's extras by name, in the table or the row.
        size: the place of the ESS.
        rows, extras: how many rows of the table and numbers of the row belong to the belief.
    """

    def __init__(self, page: Page, memory: MembersMemory, model: PagedModel):
        n, first = memory.shape.n, memory_places(memory.shape.n, memory.shape.m).extras
        self.x, self.logarithm = memory.x, input_matrix(Place("table", n), (), member=True, like=memory.x)
        self.size, self.kept = Place("rows", first), {}
        memory.end, rows = first + 1, n + 1
        self.start = with_extras(page.initial(model, memory.w))  # type: ignore[misc]
        for name, value in self.start[-1].items():
            if name in page.per_particle:
                position = Place("table", rows)
                self.kept[name] = input_matrix(
                    position, value.shape, symmetric=value.symmetric, member=True, like=memory.x
                )
                rows += prod(value.shape)
            else:
                self.kept[name] = memory.another(value, symmetric=value.symmetric)
        self.rows, self.extras, self.weight = rows, memory.end - first, Place("table", rows)
        model.extras = self.kept

    def moments(self, model: PagedModel, x: Matrix, w: Matrix, P: Matrix | None) -> tuple[Matrix, ...]:
        """Particles with their angles on one branch, their mean and their covariance."""
        x = on_branch(x, model.state_angles, w)
        cov = weighted_covariance(x, w)
        return x, wrap(weighted_mean(x, w), model.state_angles), cov if P is None else cov + weighted_mean(P, w)


def stages_of(page: Page, memory: MembersMemory, model: PagedModel) -> dict[str, Stage]:
    """Stages of a particle filter's page, by name."""
    at = Layout(page, memory, model)
    x, log_w, extras = at.x, at.logarithm, at.kept
    innovation, cov, likelihood = memory.told
    of_each = {
        "start": (on_branch(at.start[0], model.state_angles), *at.start[1:]),
        "advance": page.propagate(model, x, memory.u),
        "settle": page.add_process_noise(model, x, memory.w),
    }
    if page.rejuvenate:
        of_each["renew"] = page.rejuvenate(model, x, memory.mean, memory.P, memory.w)
    stages = {name: stored(results, (x,), extras) for name, results in of_each.items()}
    stages["choose"] = stored((weights(log_w),), (at.weight,))
    stages["summarise"] = stored(at.moments(model, x, weights(log_w), extras.get("P")), (x, *memory.belief))
    if page.lookahead:
        mu, level, v, S = page.lookahead(model, x, log_w, memory.z)
        w, first = normalised(log_w + level)
        targets_and_values: dict[Matrix | Place, Matrix] = {
            x: mu,
            log_w: -level,
            innovation: v,
            cov: S,
            at.weight: w,
            likelihood: first,
        }
        if page.rejuvenate:
            targets_and_values |= dict(zip(memory.belief, at.moments(model, mu, w, None)[1:], strict=True))
        stages["foresee"] = stored(tuple(targets_and_values.values()), tuple(targets_and_values))
        log_w = log_w + memory.read("rows", likelihood.at)
    x, log_w, *outputs, changed = with_extras(page.update(model, x, log_w, memory.z, memory.e))
    w, level = normalised(log_w)
    x, *moments = at.moments(model, x, w, changed.get("P"))
    log_w = at_least(log_w - level, LOWEST)  # a particle whose prediction is NaN gets nearly no weight
    results = x, log_w, level, effective_size(w), *moments, *outputs, changed
    targets: tuple[Matrix | Place, ...] = (
        at.x,
        at.logarithm,
        likelihood,
        at.size,
        *memory.belief,
        *(innovation, cov)[: len(outputs)],
    )
    return {**stages, "update": stored(results, targets, extras)}


# Systematic resampling of columns of a table, by weights in one of its rows.

SCRATCH_ROWS = 3


@cache
def systematic_resampler(rows: int, weights: int, scratch: int) -> Callable:
    """Return `resample(table, size, u)`: rows 0 ... rows - 1 of N columns drawn by weight, for u in (0, 1).

    New column j is the old column i whose part of the cumulated weights contains (u + j)/N of their sum: i is
    drawn N w_i times on average, rounded up or down. The function overwrites `SCRATCH_ROWS` rows from `scratch`
    on, and fills the padding of the table with copies of the first column.

    Source: Kitagawa (1996), "Monte Carlo filter and smoother for non-Gaussian nonlinear state space models",
    J. Computational and Graphical Statistics 5(1), appendix.
    """
    sums, parents, new = range(scratch, scratch + SCRATCH_ROWS)

    @inlined
    def resample(table, size, u):
        total = 0.0
        for i in range(size):
            total += table[weights, i]
            table[sums, i] = total
            table[parents, i] = 0.0
        if not total > 0.0:
            return
        # The first new column of old column i. One that is not drawn starts at the same column as the next one,
        # which overwrites it: without a random branch this takes a third of the time.
        parts = size / total
        for i in range(1, size):
            first = int(table[sums, i - 1] * parts - u + 1.0)
            if first < size:
                table[parents, first] = i
        parent = 0.0
        for j in range(size):
            parent = table[parents, j] if table[parents, j] > parent else parent
            table[parents, j] = parent
        for i in range(rows):
            for j in range(size):
                table[new, j] = table[i, int(table[parents, j])]
            for j in range(size):
                table[i, j] = table[new, j]
            for j in range(size, table.shape[1]):
                table[i, j] = table[new, 0]

    return resample


@lru_cache(maxsize=64)
def particle_kernels(page: Page, functions: Functions, shape: Shape, resample: bool = True) -> Kernels:
    """Kernels of a particle filter's page for a model's functions and shape.

    If they do not resample, a page's `rejuvenate` draws all particles again. Functions that sum over particles are
    not inlined: otherwise single steps and batches would round differently.
    """
    n, m, memory = shape.n, shape.m, MembersMemory(shape, page)
    layout = Layout(page, memory, PagedModel(memory))
    works = works_of(page, functions, shape, stages_of, layout.rows + 1)
    row_layout, source, scratch = memory_places(n, m), number_places(n, m), layout.rows + 1
    step, key_0, key_1, likelihood = row_layout.step, row_layout.key_0, row_layout.key_1, row_layout.log_likelihood
    innovation, cov = row_layout.innovation, row_layout.innovation_cov
    r_place, mean_place = source.r, row_layout.mean
    logarithm, size_place = n, layout.size.at
    threshold = page.parameter_offsets(own_place(shape)).get("resampling_threshold", 0)
    move = systematic_resampler(n + 1 if page.lookahead else layout.rows, layout.weight.at, scratch)
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
        offset, _, _, _ = uniform_block(0, row[step], FILTER_MEASUREMENT, row[key_0], row[key_1])
        move(table, size, offset)

    @inlined
    def chosen(memory, numbers, size):
        row, table, draws = memory
        choose(row, row, numbers, table, draws, size)
        resampled(memory, numbers, size)

    chosen_anew = resampled if page.lookahead else chosen
    if page.rejuvenate:
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
    if page.lookahead:
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

    rows = max(scratch + SCRATCH_ROWS, *(work.rows for work in works.values()))
    return Kernels(
        *(n, m, rows, max(n, m), start, predict if page.lookahead else predict_chosen, update, summarise),
        extras=layout.extras,
        extra_kept_rows=layout.rows - n,
    )


@inlined
def nothing(memory, numbers, size):
    """Do nothing, in place of resampling."""


@inlined
def nothing_foreseen(memory, z, numbers, size):
    """Do nothing, in place of a page's lookahead."""
