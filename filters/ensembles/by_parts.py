"""Analyses by parts: of each state with the channels near it, or of each channel in turn with the states near it.

The page of such a filter says how members move, and what they expect; its own update moves none.
"""

from __future__ import annotations

from functools import lru_cache
from math import prod

import numpy as np

from filters.engine.belief import Kernels
from filters.engine.layout import own_place
from filters.ensembles.ensemble import compare
from filters.pages.members import members_kernels
from filters.pages.page import Page
from filters.particles.motion import silencer
from thruster_env.numerics.angles import wrapped
from thruster_env.numerics.compiled import inlined
from thruster_env.numerics.tuples import column_reader, column_writer
from thruster_env.plants.layout import constants_reader, number_places
from thruster_env.plants.shape import Functions, Shape


def look(model, x, z, e):
    """The update of a page that moves no member."""
    _, _, v, S, _, level = compare(model, x, z)
    return x, v, S, level


@inlined
def moments_of(table, i, size):
    """Mean and sample variance of a row of the members."""
    mean, squares = 0.0, 0.0
    for j in range(size):
        mean += table[i, j] / size
    for j in range(size):
        squares += (table[i, j] - mean) ** 2
    return mean, squares / (size - 1)


@inlined
def transform_state(table, i, y, v, taper, size):
    """The transform filter for state i, with R of a channel over its taper; y (m, N) and v over R's root."""
    inner, along, near = np.zeros((size, size)), np.zeros(size), False
    for k in range(len(v)):
        if taper[k] > 0.0 and v[k] == v[k]:
            near = True
            for j in range(size):
                along[j] += taper[k] * y[k, j] * v[k]
                for other in range(size):
                    inner[j, other] += taper[k] * y[k, j] * y[k, other]
    mean, _ = moments_of(table, i, size)
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
def adjust_states(table, n, y, v, tapers, k, size):
    """States moved by their regression on channel k, which itself takes its measurement exactly; y, v as above."""
    squares = 0.0
    for j in range(size):
        squares += y[k, j] ** 2
    if not squares > 0.0:
        return
    shrink, gain = ((size - 1.0) / (size - 1.0 + squares)) ** 0.5 - 1.0, v[k] * squares / (size - 1.0 + squares)
    for i in range(n):
        if tapers[i, k] > 0.0:
            mean, _ = moments_of(table, i, size)
            slope = 0.0
            for j in range(size):
                slope += (table[i, j] - mean) * y[k, j]
            slope *= tapers[i, k] / squares
            for j in range(size):
                table[i, j] += slope * (gain + shrink * y[k, j])


@lru_cache(maxsize=64)
def kernels_by_parts(page: Page, functions: Functions, shape: Shape, serial: bool) -> Kernels:
    """Kernels of a page whose `model.own` has a taper (n, m) between states and channels, and a relaxation."""
    plain = members_kernels(page._replace(update=look), functions, shape)
    n, m, angles = shape.n, shape.m, np.array(shape.measurement_angles)
    constants, state, store = constants_reader(shape), column_reader(n), column_writer(m, n)
    observe, silence = functions.observe, silencer(n, shape.measurement_angles)
    tell, summarise, variances = plain.update, plain.summarise, number_places(n, m).r
    place, places = own_place(shape), {}
    for name, size_of_it in page.own:
        places[name], place = place, place + prod(size_of_it)
    taper, relaxation = places["taper"], places["relaxation"]

    @inlined
    def expect(table, z, numbers, size, y, v):
        c = constants(numbers)
        for j in range(table.shape[1]):
            store(table, j, observe(state(table, j), c))
        silence(table, z, size)
        for k in range(m):
            mean, _ = moments_of(table, n + k, size)
            scale = 1.0 / numbers[variances + k * (m + 1)] ** 0.5
            v[k] = (wrapped(z[k] - mean) if angles[k] else z[k] - mean) * scale
            for j in range(size):
                y[k, j] = (table[n + k, j] - mean) * scale

    @inlined
    def update(memory, z, numbers, size):
        tell(memory, z, numbers, size)
        _, table, _ = memory
        tapers = numbers[taper : taper + n * m].reshape((n, m))
        y, v, before = np.empty((m, size)), np.empty(m), np.empty(n)
        for i in range(n):
            _, before[i] = moments_of(table, i, size)
        expect(table, z, numbers, size, y, v)
        if serial:
            for k in range(m):
                if v[k] == v[k]:
                    expect(table, z, numbers, size, y, v)
                    adjust_states(table, n, y, v, tapers, k, size)
        else:
            for i in range(n):
                transform_state(table, i, y, v, tapers[i], size)
        if numbers[relaxation] > 0.0:
            for i in range(n):
                mean, after = moments_of(table, i, size)
                if after > 0.0:
                    factor = 1.0 + numbers[relaxation] * ((before[i] / after) ** 0.5 - 1.0)
                    for j in range(size):
                        table[i, j] = mean + factor * (table[i, j] - mean)
        summarise(memory, size)

    return plain._replace(update=update, table_rows=max(plain.table_rows, n + m))
