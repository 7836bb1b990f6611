"""Particle filters in compiled code: the stages of a page, systematic resampling, rejuvenation, and their bases.

    x, extras = initial(model, w),  w ~ N(0, I)
    if the ESS is below its threshold: particles are resampled,
    x, extras = rejuvenate(model, x, mean, P, e)
    x, extras = add_process_noise(model, propagate(model, x, u), w),  propagate once for each substep
    x, log_w, v, S, extras = update(model, x, log_w, z, e),  log_w the logarithms of the weights,  e ~ N(0, I)

`extras` is a dictionary of all that a particle carries besides x and log_w, left out if there is nothing; its `P`
is the covariance of a particle. The sum of e^log_w after an update is the likelihood, by which weights are then
divided. A page with a `lookahead` has particles resampled in the update, by the weights log_w + level:

    mu, level, v, S = lookahead(model, x, log_w, z),  mu is rejuvenated with its own mean and P,
    x, log_w, extras = update(model, mu, log_w, z, e),  log_w the logarithm of the sum of those weights, less that
                                                        of N and less the level

Sources of rejuvenation: Musso, Oudjane, Le Gland (2001), "Improving regularised particle filters"; Kotecha, Djuric
(2003), "Gaussian particle filtering"; Liu, West (2001), "Combined parameter and state estimation in
simulation-based filtering", section 10.2.3, whose discount factor d is b^2 = 1 - ((3 d - 1)/(2 d))^2 of `smooth`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, lru_cache
from math import prod
from typing import Any, ClassVar

from filters.algebra.matrices import Matrix, input_matrix
from filters.algebra.members import mean as mean_of
from filters.algebra.members import on_branch
from filters.algebra.operations import at_least, mask_missing, present, uncorrelated, wrap
from filters.algebra.points import (
    effective_size,
    log_density,
    normalised,
    outer,
    root,
    weighted_covariance,
    weighted_mean,
    weights,
)
from filters.algebra.tangents import added, local_at_measurement
from filters.engine.belief import Belief, Kernels, filter_offset, memory_offsets
from filters.ensembles.ensemble import LARGEST_ENSEMBLE
from filters.filter import FilterWithPage
from filters.pages.charts import renewed, weighted_moments
from filters.pages.kernels import MembersMemory, Stage, anything_measured, predictor, stored, with_extras
from filters.pages.kernels import member_works_of as works_of
from filters.pages.page import Page, PagedModel, acting_places
from thruster_env.core.checks import at_least as check_at_least
from thruster_env.core.checks import finite, positive
from thruster_env.core.streams import (
    FILTER_KERNEL,
    FILTER_MEASUREMENT,
    FILTER_PRIOR,
    FILTER_PROPOSAL,
    fill_normals,
    uniform_block,
)
from thruster_env.graphs.programs import Place
from thruster_env.model.shape import Functions, Shape

LOWEST = -1e300  # of logarithms of weights
SCRATCH_ROWS = 3


class Layout:
    """The layout of a particle filter's memory.

    Attributes:
        x, logarithm, weight: rows of the table: particles, log weights, and weights, which are scratch.
        extras: the page's extras by name, in the table or the row.
        size: the place of the ESS.
        rows, numbers: how many rows of the table and numbers of the row belong to the belief.
    """

    def __init__(self, page: Page, memory: MembersMemory, model: PagedModel):
        n, first = memory.shape.n, memory_offsets(memory.shape.n, memory.shape.m, memory.shape.t).extras
        self.x, self.logarithm = memory.x, input_matrix(Place("table", n), (), member=True, like=memory.x)
        self.size, self.extras = Place("rows", first), {}
        memory.end, rows = first + 1, n + 1
        *drawn, extras = with_extras(page.initial(model, memory.w))  # type: ignore[misc]
        self.start = *drawn, {**page._replace(initial=None).started(model), **extras}
        for name, value in self.start[-1].items():
            if name in page.per_particle:
                position = Place("table", rows)
                self.extras[name] = input_matrix(
                    position, value.shape, symmetric=value.symmetric, member=True, like=memory.x
                )
                rows += prod(value.shape)
            else:
                self.extras[name] = memory.another(value, symmetric=value.symmetric)
        self.rows, self.numbers, self.weight = rows, memory.end - first, Place("table", rows)
        model.extras = self.extras


def stages_of(page: Page, memory: MembersMemory, model: PagedModel) -> dict[str, Stage]:
    """Stages of a particle filter's page, by name."""
    at = Layout(page, memory, model)
    x, log_w, extras = at.x, at.logarithm, at.extras
    innovation, cov, likelihood = memory.outputs
    local, z = local_at_measurement(model, memory.z, memory.mean)  # the density of each particle is exact there
    rejuvenate = renewed(page.rejuvenate) if model.turns and page.rejuvenate else page.rejuvenate
    of_each = {
        "start": (on_branch(at.start[0], model.state_angles), *at.start[1:]),
        "propagate": page.propagated(model, x, u=memory.u),
        "add_process_noise": page.add_process_noise(model, x, memory.w),
    }
    if rejuvenate:
        of_each["renew"] = rejuvenate(model, x, memory.mean, memory.P, memory.w)
    stages = {name: stored(results, (x,), extras) for name, results in of_each.items()}
    stages["choose"] = stored((weights(log_w),), (at.weight,))
    stages["summarise"] = stored(weighted_moments(model, x, weights(log_w), extras.get("P")), (x, *memory.belief))
    if page.lookahead:
        mu, level, v, S = page.lookahead(local, x, log_w, z)
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
            targets_and_values |= dict(zip(memory.belief, weighted_moments(model, mu, w, None)[1:], strict=True))
        stages["foresee"] = stored(tuple(targets_and_values.values()), tuple(targets_and_values))
        log_w = log_w + memory.read("rows", likelihood.at)
    x, log_w, *outputs, changed = with_extras(page.update(local, x, log_w, z, memory.e))
    w, level = normalised(log_w)
    x, *moments = weighted_moments(model, x, w, changed.get("P"))
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
    row_layout, source, scratch = memory_offsets(n, m, shape.t), shape.offsets, layout.rows + 1
    step, key_0, key_1, likelihood = row_layout.step, row_layout.key_0, row_layout.key_1, row_layout.log_likelihood
    innovation, cov = row_layout.innovation, row_layout.innovation_cov
    r_offset, mean_offset = source.r, row_layout.mean
    logarithm, size_offset = n, layout.size.at
    threshold = page.parameter_offsets(filter_offset(shape)).get("resampling_threshold", 0)
    move = systematic_resampler(n + 1 if page.lookahead else layout.rows, layout.weight.at, scratch)
    (begin, _, drawn), (correct, _, proposed) = works["start"], works["update"]
    choose, moments, predict = works["choose"].work, works["summarise"].work, predictor(works, shape)

    def draw(memory, count, stream):
        row, table, draws = memory
        fill_normals(draws, count * table.shape[1], row[step], stream, row[key_0], row[key_1])

    def set_equal(memory, size):
        row, table, _ = memory
        for j in range(table.shape[1]):
            table[logarithm, j] = -math.log(size)
        row[size_offset] = size

    def start(memory, numbers, size):
        row, table, draws = memory
        draw(memory, drawn, FILTER_PRIOR)
        begin(row, numbers, numbers, table, draws, size)
        set_equal(memory, size)

    def resampled(memory, numbers, size):
        row, table, _ = memory
        offset, _, _, _ = uniform_block(0, row[step], FILTER_MEASUREMENT, row[key_0], row[key_1])
        move(table, size, offset)

    def chosen(memory, numbers, size):
        row, table, draws = memory
        choose(row, row, numbers, table, draws, size)
        resampled(memory, numbers, size)

    chosen_anew = resampled if page.lookahead else chosen
    if page.rejuvenate:
        renew, spread = works["renew"].work, works["renew"].draws
        choose_first = chosen_anew if resample else nothing

        def chosen_anew(memory, numbers, size):
            row, table, draws = memory
            choose_first(memory, numbers, size)
            draw(memory, spread, FILTER_KERNEL)
            renew(row, row, numbers, table, draws, size)

    def predict_chosen(memory, u, numbers, size):
        row, _, _ = memory
        if row[size_offset] < numbers[threshold] * size:
            chosen_anew(memory, numbers, size)
            set_equal(memory, size)
        predict(memory, u, numbers, size)

    def summarise(memory, size):
        row, table, draws = memory
        moments(row, row, row, table, draws, size)

    def tell_nothing(memory, numbers):
        row, _, _ = memory
        for i in range(m):
            row[innovation + i] = 0.0
            for k in range(m):
                row[cov + i * m + k] = numbers[r_offset + i * m + k] if i == k else 0.0
        row[likelihood] = 0.0

    first = nothing_foreseen
    if page.lookahead:
        foresee = works["foresee"].work

        def first(memory, z, numbers, size):
            row, table, draws = memory
            foresee(row, z, numbers, table, draws, size)
            chosen_anew(memory, numbers, size)
            row[likelihood] -= math.log(size)

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
            row[mean_offset] = math.nan  # no particle explains z: the belief is lost

    rows = max(scratch + SCRATCH_ROWS, *(work.rows for work in works.values()))
    return Kernels(
        *(n, m, rows, max(n, m), start, predict if page.lookahead else predict_chosen, update, summarise),
        extras=layout.numbers,
        extra_kept_rows=layout.rows - n,
        acting=acting_places(layout.extras),
        turns=len(shape.turns),
        measured_turns=len(shape.measured_turns),
    )


def nothing(memory, numbers, size):
    """Do nothing, in place of resampling."""


def nothing_foreseen(memory, z, numbers, size):
    """Do nothing, in place of a page's lookahead."""


def spread(model, x, mean, P, e):
    """Add noise of a kernel, whose covariance is a part of P, to a particle."""
    return x + root(P) @ e * model.own.width


def kernel_width(count: int, size: int) -> float:
    """The width h = (4/(d + 2))^(1/(d + 4)) N^(-1/(d + 4)) of a kernel for N particles in d dimensions.

    It minimises the mean integrated square error of a Gaussian density.

    Source: Silverman (1986), Density Estimation for Statistics and Data Analysis, section 4.3.2.
    """
    return (4.0 / ((count + 2.0) * size)) ** (1.0 / (count + 4.0))


def draw(model, x, mean, P, e):
    """Draw a particle from N(mean, P), in place of x."""
    return mean + root(P) @ e


def smooth(model, x, mean, P, e):
    """Shrink the `smoothed` states towards their mean, and add noise so that their covariance stays."""
    parameters = model.own
    L = root(P * outer(parameters.smoothed, parameters.smoothed))
    return x - parameters.smoothed * (x - mean_of(x)) * parameters.drawn + L @ e * parameters.width


def initial_weighted(model, w):
    """Draw a particle from the prior."""
    return added(model, model.prior_mean, model.prior_root @ w)


def expect(model, x, log_w, z):
    """The predicted measurement of a particle, zero in channels that are NaN in z; innovation and S of all."""
    measured, w = present(z), weights(log_w)
    y = on_branch(mask_missing(measured, model.h(x)), model.measurement_angles, w)
    v = mask_missing(measured, wrap(z - weighted_mean(y, w), model.measurement_angles))
    return y, v, weighted_covariance(y, w) + uncorrelated(measured, model.R)


def fit(model, y, z):
    """The logarithm of p(z | x) of a particle with the predicted measurement y."""
    measured = present(z)
    rest = mask_missing(measured, wrap(z - y, model.measurement_angles))
    return log_density(rest, uncorrelated(measured, model.R), measured)


@dataclass(frozen=True, kw_only=True, eq=False)
class WeightedFilter(FilterWithPage):
    """Base of the particle filters.

    Attributes:
        ensemble_size: number N of particles, from 2 to a million.
        regularisation: factor on the width of the Gaussian kernel that spreads resampled particles; 0 for none, 1
            for the best width for a Gaussian belief. With little or no process noise, nothing else separates the
            copies of a particle.
    """

    gaussian_likelihood: ClassVar[bool] = False
    any_step: ClassVar[bool] = False
    resampled: ClassVar[bool] = True
    ensemble_size: int = 1000
    regularisation: float = 0.0

    def __post_init__(self):
        size = check_at_least("ensemble_size", self.ensemble_size, 2)
        if size > LARGEST_ENSEMBLE:
            raise ValueError(f"ensemble_size must be at most {LARGEST_ENSEMBLE}, but got {size}")
        object.__setattr__(self, "ensemble_size", size)
        width = positive("regularisation", self.regularisation, zero_allowed=True)
        object.__setattr__(self, "regularisation", width)

    @property
    def parameters(self) -> Mapping[str, Any]:
        """The parameters of the page: the width of the kernel, over the standard deviations of all particles."""
        return {"width": self.regularisation * kernel_width(self.spread_states, self.ensemble_size)}

    @property
    def spread_states(self) -> int:
        """Number of states that the kernel spreads."""
        return self.model.t

    @property
    def takes_rotations(self) -> bool:
        """Whether it takes the parts of its model that turn: the noise of a direction cannot be taken back."""
        goes_back = self.written_page.per_particle == ("noise",)
        return not (goes_back and any(turn.kind == "direction" for turn in self.model.turns))

    @property
    def shape(self) -> Shape:
        """The shape of its model; ValueError for parts that it does not take."""
        return self.kernel_model.any_shape if self.takes_rotations else self.kernel_model.shape

    @property
    def written_page(self) -> Page:
        """The page, with the kernel if its width is not zero."""
        page = super().written_page
        return page if self.regularisation else page._replace(rejuvenate=None)

    @property
    def size(self) -> int:
        """Number of particles."""
        return self.ensemble_size

    def kernels(self) -> Kernels:
        """Kernels of the page for the model's functions; see `Filter.kernels`."""
        return particle_kernels(self.written_page, self.kernel_model.functions, self.shape)

    @staticmethod
    def effective_sample_size(belief: Belief) -> float:
        """The effective number of equally weighted particles, from 1 to N."""
        return float(belief.extras[0])


@dataclass(frozen=True, kw_only=True, eq=False)
class ResampledFilter(WeightedFilter):
    """Base of the particle filters that resample when few particles have most of the weight.

    Attributes:
        resampling_threshold: fraction of N; an effective sample size (ESS) below it triggers resampling; from 0
            (never) to 1.
    """

    resampling_threshold: float = 0.5

    def __post_init__(self):
        super().__post_init__()
        threshold = finite("resampling_threshold", self.resampling_threshold)
        if not 0.0 <= threshold <= 1.0:
            raise ValueError(f"resampling_threshold must be from 0 to 1, but got {threshold}")
        object.__setattr__(self, "resampling_threshold", threshold)

    @property
    def parameters(self) -> Mapping[str, Any]:
        """The parameters of the page and of resampling."""
        return {**super().parameters, "resampling_threshold": self.resampling_threshold}
