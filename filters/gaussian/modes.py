"""Several filters in one row of numbers, each with a model of its own: they are mixed, run, weighed and merged."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import NamedTuple

from filters.algebra.matrices import given
from filters.engine.belief import Kernels
from filters.engine.layout import memory_places, own_place
from filters.engine.restart import restart_if_lost
from filters.gaussian.absent import Absent, completer
from filters.gaussian.mixture import Parts, blender, log_weigher, logarithm, nothing
from filters.pages.kernels import anything_measured, nothing_to_summarise
from filters.pages.programs import stored, works_of
from thruster_env.core.compiled import inlined
from thruster_env.graphs.programs import Place
from thruster_env.model.layout import number_places, starts_of
from thruster_env.model.shape import Shape

LOST = 700.0  # what the log-likelihood of a mode whose filter begins anew is below the least of the others


class Mode(NamedTuple):
    """The filter of a mode, and how many numbers it and its model are."""

    kernels: Kernels
    length: int


@lru_cache(maxsize=64)
def mode_kernels(
    modes: tuple[Mode, ...], shape: Shape, absent: tuple[Absent, ...] = (), mixing: Callable | None = None
) -> Kernels:
    """Kernels for filters of the same states, inputs and measurements as `shape`, some of which modes may lack.

    The filter's own numbers are p (K,), Pi (K, K) by columns, and those of each mode. Extras: the memory of each
    mode's filter, then the logarithms of the probabilities. `mixing(p, mu)` gives for a column of Pi the weights
    of all modes with which one begins a step, and its probability; without it each filter runs by itself.
    """
    n, m, count, belief = shape.n, shape.m, len(modes), shape.n + shape.n**2
    at, own = memory_places(n, m), own_place(shape)
    first, stride = at.extras, at.extras + max(one.kernels.extras + one.kernels.scratch for one in modes)
    parts, logs = Parts(first, stride, count), first + count * stride
    probabilities = logs + count  # what follows is scratch
    completing = probabilities + count * (3 + belief)  # behind what `_mixer` needs
    end = completing + (count + belief) * bool(absent)
    of_states = blender(parts, n, at.mean, at.cov, shape.state_angles)
    of_innovations = blender(parts, m, at.innovation, at.innovation_cov, shape.measurement_angles, wraps=False)
    innovation, level, step, lost = at.innovation, at.log_likelihood, at.step, at.divergences
    of_modes = [own + count + count * count + start for start in starts_of(*(one.length for one in modes))]
    start_all, predict_all, update_all = _of_all(modes, parts, of_modes)
    model = number_places(n, m)
    priors = [(place + model.prior_mean, place + model.prior_cov) for place in of_modes[:-1]]
    complete = completer(absent, parts, n, of_states, priors, completing)
    weigh = log_weigher(parts, level)

    @inlined
    def blend(row, weights, numbers, target):
        complete(row, weights, numbers)
        of_states(row, weights, target)

    mix = nothing if mixing is None else _mixer(mixing, parts, belief, logs, own + count, blend)

    @inlined
    def recall(row):
        for j in range(count):
            row[probabilities + j] = math.exp(row[logs + j])

    @inlined
    def start(memory, numbers, size):
        row, _, _ = memory
        for i in range(first, end):
            row[i] = 0.0
        for j in range(count):
            row[logs + j] = logarithm(numbers[own + j])
        recall(row)
        start_all(memory, numbers, numbers)
        blend(row, probabilities, numbers, 0)

    @inlined
    def predict(memory, u, numbers, size):
        row, _, _ = memory
        mix(memory, u, numbers)
        recall(row)
        predict_all(memory, u, numbers)
        blend(row, probabilities, numbers, 0)
        row[step] += 1.0

    @inlined
    def update(memory, z, numbers, size):
        row, _, _ = memory
        recall(row)
        begun = 0.0
        for j in range(count):
            begun -= row[first + j * stride + lost]
        update_all(memory, z, numbers)
        for j in range(count):
            begun += row[first + j * stride + lost]
        of_innovations(row, probabilities, innovation)
        row[level], least = 0.0, -math.inf
        if anything_measured(z):
            least = math.inf
            for j in range(count):
                part = first + j * stride
                if not row[part + lost] > 0.0:
                    least = min(least, row[part + level])
            for j in range(count):
                part = first + j * stride
                if row[part + lost] > 0.0:  # it has begun anew: it says nothing of this measurement
                    row[part + lost], row[part + level] = 0.0, least - LOST if least < math.inf else -math.inf
            row[level] = weigh(row, logs, probabilities)
        if begun > 0.0 and least < math.inf:
            row[lost] += 1.0  # modes begin anew: of all of them the likelihood is 0, and the whole belief restarts
        blend(row, probabilities, numbers, 0)

    kept = probabilities - first
    return Kernels(
        n, m, n, 0, start, predict, update, nothing_to_summarise, extras=kept, scratch=end - first - kept
    )


def _mixer(mixing: Callable, parts: Parts, belief: int, logs: int, transitions: int, blend: Callable) -> Callable:
    """Return `mix(memory, u, numbers)`: the belief with which each filter begins is a mixture of all.

    Of the probabilities mu a column has the ratios to the largest that leads to its mode, which is as good.
    """
    first, stride, count = parts
    ratios, foreseen, shares, mixed = (logs + k * count for k in (1, 2, 3, 4))
    p, mu = given(Place("numbers", 0), (count,)), given(Place("rows", ratios), (count,))
    (share,) = works_of(stored(mixing(p, mu), (Place("rows", shares), Place("given", 0))))

    @inlined
    def mix(memory, u, numbers):
        row, _, _ = memory
        for j in range(count):
            column, top = transitions + j * count, -math.inf
            for i in range(count):
                if numbers[column + i] > 0.0:
                    top = max(top, row[logs + i])
            if top > -math.inf:
                for i in range(count):
                    row[ratios + i] = math.exp(row[logs + i] - top) if numbers[column + i] > 0.0 else 0.0
                share(row, row[foreseen + j :], numbers[column:])
                row[foreseen + j] = top + logarithm(row[foreseen + j])
            else:  # no mode leads to this one: its filter goes on
                row[foreseen + j] = -math.inf
                for i in range(count):
                    row[shares + i] = 1.0 if i == j else 0.0
            blend(row, shares, numbers, mixed + j * belief)
        for j in range(count):
            row[logs + j] = row[foreseen + j]
            for i in range(belief):
                row[first + j * stride + i] = row[mixed + j * belief + i]

    return mix


def _of_all(modes: tuple[Mode, ...], parts: Parts, numbers: Sequence[int]) -> tuple[Callable, ...]:
    """Functions (memory, given, numbers) that start, predict and update the filters of all modes."""
    at: dict[Kernels, list[tuple[int, int, int]]] = {}
    for j, one in enumerate(modes):
        at.setdefault(one.kernels, []).append((parts.first + j * parts.stride, numbers[j], numbers[j + 1]))
    works: tuple[Callable, ...] = nothing, nothing, nothing
    for kernels, places in at.items():
        works = _then(works, kernels, tuple(places), parts.stride)
    return works


def _then(before: tuple, kernels: Kernels, places: tuple, stride: int) -> tuple[Callable, ...]:
    """The same with some modes more, which have the same kernels, by the places of their rows and numbers."""
    start_others, predict_others, update_others = before
    begin, move, correct, restart = kernels.start, kernels.predict, kernels.update, restart_if_lost(kernels)

    @inlined
    def start(memory, given, numbers):
        start_others(memory, given, numbers)
        row, table, draws = memory
        for place, first, last in places:
            begin((row[place : place + stride], table, draws), numbers[first:last], 0)

    @inlined
    def predict(memory, u, numbers):
        predict_others(memory, u, numbers)
        row, table, draws = memory
        for place, first, last in places:
            move((row[place : place + stride], table, draws), u, numbers[first:last], 0)

    @inlined
    def update(memory, z, numbers):
        update_others(memory, z, numbers)
        row, table, draws = memory
        for place, first, last in places:
            mode, of_mode = (row[place : place + stride], table, draws), numbers[first:last]
            correct(mode, z, of_mode, 0)
            restart(mode, of_mode, 0)

    return start, predict, update
