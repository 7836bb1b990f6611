"""Analyses in parts: each state with the channels near it, or one channel after the other.

The page of such a filter propagates the members and predicts their measurements, but its update moves no member.
The table has a row for each state, then one for each channel with independent noise of variance 1.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from statistics import NormalDist
from typing import Any, ClassVar

import numpy as np

from filters.algebra.matrices import input_matrix
from filters.algebra.members import mean
from filters.algebra.operations import mask_missing, present, uncorrelated, wrap
from filters.algebra.points import root
from filters.algebra.roots import forward_quotient
from filters.engine.belief import Kernels, filter_offset, memory_offsets
from filters.ensembles.ensemble import compare, expect
from filters.ensembles.stochastic import DeterministicUpdateFilter, LocalisedFilter, with_rotation
from filters.pages.kernels import MembersMemory, Stage, extras_size, members_kernels, stored
from filters.pages.kernels import member_works_of as works_of
from filters.pages.page import Page
from thruster_env.core.compiled import inlined
from thruster_env.graphs.programs import Place
from thruster_env.model.shape import Functions, Shape

LEAST = 1e-3  # tapers below are set to zero


@inlined
def row_moments(table, i, size):
    """Mean and sample variance of a row of the members."""
    mean, squares = 0.0, 0.0
    for j in range(size):
        mean += table[i, j] / size
    for j in range(size):
        squares += (table[i, j] - mean) ** 2
    return mean, squares / (size - 1)


@inlined
def stretch_row(table, i, factor, size):
    """Multiply a row's deviations from its mean by a factor."""
    mean = 0.0
    for j in range(size):
        mean += table[i, j] / size
    for j in range(table.shape[1]):
        table[i, j] = mean + factor * (table[i, j] - mean)


@inlined
def relax_row(table, i, before, part, size):
    """Restore a part of an update's reduction of a row's standard deviation; `before` is the variance before."""
    _, after = row_moments(table, i, size)
    if after > 0.0:
        stretch_row(table, i, 1.0 + part * ((before / after) ** 0.5 - 1.0), size)


@inlined
def transform_state(table, i, n, v, z, taper, size):
    """Update state i by the transform filter, with R of each channel divided by its taper."""
    inner, along, near = np.zeros((size, size)), np.zeros(size), False
    for k in range(len(v)):
        if taper[k] > 0.0 and z[k] == z[k]:
            near = True
            for j in range(size):
                along[j] += taper[k] * table[n + k, j] * v[k]
                for other in range(size):
                    inner[j, other] += taper[k] * table[n + k, j] * table[n + k, other]
    mean, _ = row_moments(table, i, size)
    total = mean
    for j in range(size):
        inner[j, j] += size - 1.0
        total += inner[j, j]
    if not near:
        return
    if not abs(total) < np.inf:  # a belief that is lost
        table[i, :] = np.nan
        return
    values, vectors = np.linalg.eigh(inner)
    updated = np.full(size, mean)
    for axis in range(size):
        state, w = 0.0, 0.0
        for j in range(size):
            state += vectors[j, axis] * (table[i, j] - mean)
            w += vectors[j, axis] * along[j]
        for j in range(size):
            updated[j] += state * (w / values[axis] + ((size - 1.0) / values[axis]) ** 0.5 * vectors[j, axis])
    for j in range(size):
        table[i, j] = updated[j]


@inlined
def gaussian_moves(y, v, tail, moves, size):
    """Moves of a channel's y (N,), with R = 1, for a measurement v, by the adjustment filter."""
    squares = 0.0
    for j in range(size):
        squares += y[j] ** 2
    gain, shrink = squares / (size - 1.0 + squares), ((size - 1.0) / (size - 1.0 + squares)) ** 0.5 - 1.0
    for j in range(size):
        moves[j] = gain * v + shrink * y[j]


@inlined
def regress(table, n, y, moves, taper, size):
    """Move states by their regression on a channel's y, from the moves of y."""
    squares = 0.0
    for j in range(size):
        squares += y[j] ** 2
    for i in range(n):
        if taper[i] > 0.0 and squares > 0.0:
            mean, _ = row_moments(table, i, size)
            slope = 0.0
            for j in range(size):
                slope += (table[i, j] - mean) * y[j]
            for j in range(size):
                table[i, j] += slope * taper[i] / squares * moves[j]


def with_unit_noise(page: Page, memory: MembersMemory, model) -> dict[str, Stage]:
    """M^-1 (y - mean(y)) of members and M^-1 (z - mean(y)), with M M' = R: channels with independent noise."""
    measured, n, m = present(memory.z), memory.shape.n, memory.shape.m
    model.extras = memory.keep(page.started(model))  # the input that acts, if h takes it
    y, M = expect(model, memory.x, memory.z), root(uncorrelated(measured, model.R))
    v = mask_missing(measured, wrap(memory.z - mean(y), model.measurement_angles))
    rows = input_matrix(Place("table", n), (m,), member=True, like=memory.x)
    target = memory.read("rows", scratch_offset(page, memory.shape), m)
    return {"update": stored((forward_quotient(M, y - mean(y)), forward_quotient(M, v)), (rows, target))}


def scratch_offset(page: Page, shape: Shape) -> int:
    """The offset of scratch in a filter's row, after the extras of a page."""
    return memory_offsets(shape.n, shape.m).extras + extras_size(page, shape)


@lru_cache(maxsize=64)
def kernels_by_parts(page: Page, functions: Functions, shape: Shape, moves_of: Callable | None) -> Kernels:
    """Kernels of a page whose `model.own` has a taper (n, m) of states and channels, relaxation, and a tail.

    The update goes through the channels, whose y move by `moves_of(y, v, tail, moves, size)`; if that is None, it
    goes through the states.
    """
    plain, n, m = members_kernels(page, functions, shape), shape.n, shape.m
    look, rows, _ = works_of(page, functions, shape, with_unit_noise, n + m)["update"]
    tell, summarise, first = plain.update, plain.summarise, scratch_offset(page, shape)
    serial, move = moves_of is not None, gaussian_moves if moves_of is None else moves_of
    offsets = page.parameter_offsets(filter_offset(shape))
    taper, relaxation, tail = offsets["taper"], offsets["relaxation"], offsets["tail"]

    @inlined
    def update(memory, z, numbers, size):
        tell(memory, z, numbers, size)
        row, table, draws = memory
        tapers = numbers[taper : taper + n * m].reshape((n, m))
        v, moves, before = row[first : first + m], np.empty(size), np.empty(n)
        if numbers[relaxation] > 0.0:
            for i in range(n):
                _, before[i] = row_moments(table, i, size)
        look(row, z, numbers, table, draws, size)
        if serial:
            for k in range(m):
                if z[k] == z[k]:
                    if k > 0:
                        look(row, z, numbers, table, draws, size)
                    y = table[n + k, :size]
                    move(y, v[k], numbers[tail], moves, size)
                    regress(table, n, y, moves, tapers[:, k], size)
        else:
            for i in range(n):
                transform_state(table, i, n, v, z, tapers[i], size)
        if numbers[relaxation] > 0.0:
            for i in range(n):
                relax_row(table, i, before[i], numbers[relaxation], size)
        summarise(memory, size)

    return plain._replace(update=update, table_rows=max(plain.table_rows, rows), scratch=m)


def look(model, x, z, e):
    """An update that moves no member: it only returns innovation, S and likelihood."""
    _, _, v, S, _, level = compare(model, x, z)
    return x, v, S, level


@dataclass(frozen=True, kw_only=True, eq=False)
class LocalisedByParts(LocalisedFilter, DeterministicUpdateFilter):
    """Base of filters whose update goes through states or channels if there is a radius.

    Channels with correlated noise are first made independent, by the lower triangular root of R, and keep their
    positions. Such an update is neither in C nor on tensors.
    """

    moves_of: ClassVar[Callable | None] = None  # of one channel after the other, see `kernels_by_parts`

    @property
    def by_parts(self) -> bool:
        """Whether the update is by parts."""
        return bool(self.radius)

    @property
    def tapers(self) -> Mapping[str, Any]:
        """Tapers between states and channels, (n, m), and the normal quantile of 1/(N + 1); none without parts."""
        if not self.by_parts:
            return {}
        taper = super().tapers.get("taper", np.ones((self.model.n, self.model.m)))
        tail = NormalDist().inv_cdf(1.0 / (self.ensemble_size + 1))
        return {"taper": np.where(taper > LEAST, taper, 0.0), "tail": tail}

    @property
    def plain_page(self) -> Page:
        """The page without inflation and relaxation; if the update is by parts, its update moves no member."""
        page = super().plain_page
        return page._replace(update=look) if self.by_parts else page

    def kernels(self) -> Kernels:
        """Kernels for the model's functions; see `Filter.kernels`."""
        if not self.by_parts:
            return super().kernels()
        page, model = self.page_with(self.inflation != 1.0, relaxation=False), self.kernel_model
        kernels = kernels_by_parts(page, model.functions, model.shape, type(self).moves_of)
        return with_rotation(kernels) if self.rotations else kernels
