"""Analyses by parts: of each state with the channels near it, or of each channel in turn with the states near it.

The page of such a filter says how members move, and what they expect; its own update moves none.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from statistics import NormalDist
from typing import Any, ClassVar

import numpy as np

from filters.engine.belief import Kernels
from filters.engine.layout import own_place
from filters.ensembles.deterministic import DeterministicUpdateFilter
from filters.ensembles.localised import LocalisedFilter
from filters.ensembles.rotation import with_rotation
from filters.ensembles.rows import row_moments
from filters.ensembles.steps import compare
from filters.pages.members import members_kernels
from filters.pages.page import Page
from filters.particles.motion import silencer
from thruster_env.numerics.angles import wrapped
from thruster_env.numerics.compiled import inlined
from thruster_env.numerics.tuples import column_reader, column_writer
from thruster_env.plants.layout import constants_reader, number_places
from thruster_env.plants.shape import Functions, Shape

LEAST = 1e-3  # tapers below are zero


def look(model, x, z, e):
    """The update of a page that moves no member."""
    _, _, v, S, _, level = compare(model, x, z)
    return x, v, S, level


@inlined
def transform_state(table, i, y, v, taper, size):
    """The transform filter for state i, with R of a channel over its taper; y (m, N) and v have the R of 1."""
    inner, along, near = np.zeros((size, size)), np.zeros(size), False
    for k in range(len(v)):
        if taper[k] > 0.0 and v[k] == v[k]:
            near = True
            for j in range(size):
                along[j] += taper[k] * y[k, j] * v[k]
                for other in range(size):
                    inner[j, other] += taper[k] * y[k, j] * y[k, other]
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
    moved = np.full(size, mean)
    for one in range(size):
        state, z = 0.0, 0.0
        for j in range(size):
            state += vectors[j, one] * (table[i, j] - mean)
            z += vectors[j, one] * along[j]
        for j in range(size):
            moved[j] += state * (z / values[one] + ((size - 1.0) / values[one]) ** 0.5 * vectors[j, one])
    for j in range(size):
        table[i, j] = moved[j]


@inlined
def gaussian_moves(y, v, tail, moves, size):
    """How a channel's y (N,), of variance 1 in R, moves to a measurement v as the adjustment filter has it."""
    squares = 0.0
    for j in range(size):
        squares += y[j] ** 2
    gain, shrink = squares / (size - 1.0 + squares), ((size - 1.0) / (size - 1.0 + squares)) ** 0.5 - 1.0
    for j in range(size):
        moves[j] = gain * v + shrink * y[j]


@inlined
def regress(table, n, y, moves, tapers, k, size):
    """States moved by their regression on channel k, whose y moves."""
    squares = 0.0
    for j in range(size):
        squares += y[k, j] ** 2
    for i in range(n):
        if tapers[i, k] > 0.0 and squares > 0.0:
            mean, _ = row_moments(table, i, size)
            slope = 0.0
            for j in range(size):
                slope += (table[i, j] - mean) * y[k, j]
            for j in range(size):
                table[i, j] += slope * tapers[i, k] / squares * moves[j]


@inlined
def root_of(numbers, first, z, root):
    """The lower triangular root (m, m) of R, from `first` on, without correlations to missing channels."""
    m = len(z)
    for i in range(m):
        for j in range(i + 1):
            total = numbers[first + i * m + j] if i == j or (z[i] == z[i] and z[j] == z[j]) else 0.0
            for k in range(j):
                total -= root[i, k] * root[j, k]
            root[i, j] = total**0.5 if i == j else total / root[j, j]


@lru_cache(maxsize=64)
def kernels_by_parts(page: Page, functions: Functions, shape: Shape, moves_of: Callable | None) -> Kernels:
    """Kernels of a page whose `model.own` has a taper (n, m) of states and channels, relaxation, and a tail.

    The update goes through channels, each of which moves by `moves_of(y, v, tail, moves, size)`; through states if
    that is None.
    """
    plain = members_kernels(page, functions, shape)
    n, m, angles, serial = shape.n, shape.m, np.array(shape.measurement_angles), moves_of is not None
    constants, state, store = constants_reader(shape), column_reader(n), column_writer(m, n)
    observe, silence = functions.observe, silencer(n, shape.measurement_angles)
    tell, summarise, first = plain.update, plain.summarise, number_places(n, m).r
    places = page.places(own_place(shape))
    taper, relaxation, tail = places["taper"], places["relaxation"], places["tail"]
    move = gaussian_moves if moves_of is None else moves_of

    @inlined
    def expect(table, z, numbers, size, root, y, v):
        c = constants(numbers)
        for j in range(table.shape[1]):
            store(table, j, observe(state(table, j), c))
        silence(table, z, size)
        for k in range(m):
            mean, _ = row_moments(table, n + k, size)
            v[k] = wrapped(z[k] - mean) if angles[k] else z[k] - mean
            for j in range(size):
                y[k, j] = table[n + k, j] - mean
            for other in range(k + 1):
                part = root[k, other]
                if other == k:
                    v[k] /= part
                    for j in range(size):
                        y[k, j] /= part
                elif part != 0.0:
                    v[k] -= part * v[other]
                    for j in range(size):
                        y[k, j] -= part * y[other, j]

    @inlined
    def update(memory, z, numbers, size):
        tell(memory, z, numbers, size)
        _, table, _ = memory
        tapers = numbers[taper : taper + n * m].reshape((n, m))
        y, v, root, moves, before = np.empty((m, size)), np.empty(m), np.zeros((m, m)), np.empty(size), np.empty(n)
        for i in range(n):
            _, before[i] = row_moments(table, i, size)
        root_of(numbers, first, z, root)
        expect(table, z, numbers, size, root, y, v)
        if serial:
            for k in range(m):
                if z[k] == z[k]:
                    if k > 0:
                        expect(table, z, numbers, size, root, y, v)
                    move(y[k], v[k], numbers[tail], moves, size)
                    regress(table, n, y, moves, tapers, k, size)
        else:
            for i in range(n):
                transform_state(table, i, y, v, tapers[i], size)
        if numbers[relaxation] > 0.0:
            for i in range(n):
                mean, after = row_moments(table, i, size)
                if after > 0.0:
                    factor = 1.0 + numbers[relaxation] * ((before[i] / after) ** 0.5 - 1.0)
                    for j in range(size):
                        table[i, j] = mean + factor * (table[i, j] - mean)
        summarise(memory, size)

    return plain._replace(update=update, table_rows=max(plain.table_rows, n + m))


@dataclass(frozen=True, kw_only=True, eq=False)
class LocalisedByParts(LocalisedFilter, DeterministicUpdateFilter):
    """Base of those whose update goes through states or channels, if there is a radius.

    Channels with correlated noise are first made independent, by the lower triangular root of R, and lie where
    they lay. Such an update is neither in C nor on tensors.
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
        """The page without what controls the spread; one that goes by parts moves no member in an update."""
        page = super().plain_page
        return page._replace(update=look) if self.by_parts else page

    def kernels(self) -> Kernels:
        """Kernels for the model's functions; see `Filter.kernels`."""
        if not self.by_parts:
            return super().kernels()
        page, model = self.page_with(self.inflation != 1.0, relaxation=False), self.kernel_model
        kernels = kernels_by_parts(page, model.functions, model.shape, type(self).moves_of)
        return with_rotation(kernels) if self.rotations else kernels
