"""Several filters in one row of numbers, each with a model of its own: they are mixed, run, weighed and merged."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

from filters.engine.belief import Kernels
from filters.engine.layout import memory_places, own_place, row_access
from filters.engine.restart import restart_if_lost
from filters.gaussian.absent import Absent, Parts, completer
from filters.gaussian.mixture import blender
from filters.pages.kernels import anything_measured, nothing_to_summarise
from thruster_env.numerics.compiled import inlined
from thruster_env.plants.layout import number_places
from thruster_env.plants.shape import Shape


class Mode(NamedTuple):
    """The filter of a mode, and how many numbers it and its model are."""

    kernels: Kernels
    length: int


class Places(NamedTuple):
    """First places in the row: K parts, each a filter's row and a weight; the probabilities; then scratch."""

    parts: int
    stride: int
    probabilities: int
    foreseen: int  # probabilities before the measurement
    mixed: int  # means and covariances with which filters begin a step
    end: int


def mode_places(modes: tuple[Mode, ...], n: int, m: int) -> Places:
    """Places for some modes of n states and m measurements."""
    row = memory_places(n, m).extras
    stride = row + 1 + max(one.kernels.extras + one.kernels.scratch for one in modes)
    probabilities = row + len(modes) * stride
    foreseen = probabilities + len(modes)
    mixed = foreseen + len(modes)
    return Places(row, stride, probabilities, foreseen, mixed, mixed + len(modes) * (n + n * n))


@lru_cache(maxsize=64)
def mode_kernels(modes: tuple[Mode, ...], shape: Shape, absent: tuple[Absent, ...] = ()) -> Kernels:
    """Kernels for filters of the same states, inputs and measurements as `shape`, some of which modes may lack.

    The filter's own numbers are p (K,), Pi (K, K) by rows, and those of each mode.
    """
    n, m, count = shape.n, shape.m, len(modes)
    row_places, places, own = memory_places(n, m), mode_places(modes, n, m), own_place(shape)
    first, stride, probabilities, foreseen, mixed, completing = places
    mean_place, cov_place, likelihood_place = row_places.mean, row_places.cov, row_places.log_likelihood
    step_place, lost_place, weight_place = row_places.step, row_places.divergences, first + stride - 1
    transitions, belief = own + count, n + n * n
    means, covs, seen, seen_covs = (
        first + place for place in (mean_place, cov_place, row_places.innovation, row_places.innovation_cov)
    )
    of_states = blender(n, means, covs, weight_place, stride, shape.state_angles)
    of_innovations = blender(m, seen, seen_covs, weight_place, stride, shape.measurement_angles)
    _, (store_mean, store_cov), (store_innovation, store_s) = row_access(shape)
    start_all, predict_all, update_all = _of_all(modes, first, stride, own + count + count * count)
    parts = Parts(means, covs, weight_place, stride, count, completing)
    complete = completer(absent, parts, n, of_states, (store_mean, store_cov), _priors(modes, shape))
    end = completing + (count + belief if absent else 0)

    @inlined
    def take_weights(row, place):
        for j in range(count):
            row[weight_place + j * stride] = row[place + j]

    @inlined
    def merge(row, numbers):
        take_weights(row, probabilities)
        complete(row, numbers)
        mean, p = of_states(row, count)
        store_mean(row, mean)
        store_cov(row, p)

    @inlined
    def start(memory, numbers, size):
        row, _, _ = memory
        for i in range(first, end):
            row[i] = 0.0
        for j in range(count):
            row[probabilities + j] = numbers[own + j]
        start_all(memory, numbers, numbers)
        merge(row, numbers)

    @inlined
    def mix(row, numbers):
        """Each filter begins with the mixture of all, weighted by how likely its mode follows from theirs."""
        for j in range(count):
            total = 0.0
            for i in range(count):
                total += numbers[transitions + i * count + j] * row[probabilities + i]
            row[foreseen + j] = total
            for i in range(count):
                came = numbers[transitions + i * count + j] * row[probabilities + i]
                row[weight_place + i * stride] = came / total if total > 0.0 else 1.0 if i == j else 0.0
            complete(row, numbers)
            mean, p = of_states(row, count)
            begun = row[mixed + j * belief : mixed + (j + 1) * belief]
            store_mean(begun, mean)
            store_cov(begun, p)
        for j in range(count):
            row[probabilities + j] = row[foreseen + j]
            for i in range(belief):
                row[means + j * stride + i] = row[mixed + j * belief + i]

    @inlined
    def predict(memory, u, numbers, size):
        row, _, _ = memory
        mix(row, numbers)
        predict_all(memory, u, numbers)
        merge(row, numbers)
        row[step_place] += 1.0

    @inlined
    def weigh(row):
        """Probabilities after the measurement; returns the log of what they summed up to."""
        top = -math.inf
        for j in range(count):
            part = first + j * stride
            if row[part + lost_place] > 0.0:  # it has begun anew: it says nothing of this measurement
                row[part + lost_place], row[part + likelihood_place] = 0.0, -math.inf
            top = max(top, row[part + likelihood_place])
        total = 0.0
        for j in range(count):
            row[probabilities + j] *= math.exp(row[first + j * stride + likelihood_place] - top)
            total += row[probabilities + j]
        for j in range(count):
            row[probabilities + j] /= total
        return top + math.log(total)

    @inlined
    def update(memory, z, numbers, size):
        row, _, _ = memory
        update_all(memory, z, numbers)
        take_weights(row, probabilities)
        innovation, s = of_innovations(row, count)
        store_innovation(row, innovation)
        store_s(row, s)
        row[likelihood_place] = weigh(row) if anything_measured(z) else 0.0
        merge(row, numbers)

    kept = foreseen - first
    return Kernels(
        n, m, n, 0, start, predict, update, nothing_to_summarise, extras=kept, scratch=end - first - kept
    )


def _priors(modes: tuple[Mode, ...], shape: Shape) -> list[tuple[int, int]]:
    """Places of the prior mean and covariance of each mode's model in the filter's numbers."""
    place, model, found = own_place(shape) + len(modes) * (len(modes) + 1), number_places(shape.n, shape.m), []
    for one in modes:
        found.append((place + model.prior_mean, place + model.prior_cov))
        place += one.length
    return found


def _of_all(modes: tuple[Mode, ...], first: int, stride: int, numbers_place: int) -> tuple[Callable, ...]:
    """Functions (memory, given, numbers) that start, predict and update the filters of all modes."""
    at: dict[Kernels, list[tuple[int, int, int]]] = {}
    for j, one in enumerate(modes):
        at.setdefault(one.kernels, []).append((first + j * stride, numbers_place, numbers_place + one.length))
        numbers_place += one.length
    start = predict = update = _nothing
    for kernels, places in at.items():
        begin, move, correct, restart = kernels.start, kernels.predict, kernels.update, restart_if_lost(kernels)
        start = _then(start, _started(begin), tuple(places), stride)
        predict = _then(predict, move, tuple(places), stride)
        update = _then(update, _or_restarted(correct, restart), tuple(places), stride)
    return start, predict, update


@inlined
def _nothing(memory, given, numbers):
    """Before the first kind of filter."""


def _started(begin: Callable) -> Callable:
    @inlined
    def start(memory, given, numbers, size):
        begin(memory, numbers, size)

    return start


def _or_restarted(correct: Callable, restart: Callable) -> Callable:
    @inlined
    def update(memory, z, numbers, size):
        correct(memory, z, numbers, size)
        restart(memory, numbers, size)

    return update


def _then(before: Callable, work: Callable, places: tuple[tuple[int, int, int], ...], stride: int) -> Callable:
    """Do `before`, then work on the rows and numbers of some modes."""

    @inlined
    def both(memory, given, numbers):
        before(memory, given, numbers)
        row, table, draws = memory
        for place, begin, end in places:
            work((row[place : place + stride - 1], table, draws), given, numbers[begin:end], 0)

    return both
