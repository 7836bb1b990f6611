"""Filters that run a page on each part of a mixture, as kernels of the engine."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from math import prod
from typing import Any, NamedTuple

from filters.algebra.densities import log_density
from filters.algebra.operations import present
from filters.engine.belief import Kernels
from filters.engine.layout import memory_places, own_place
from filters.gaussian.extended import ExtendedKalmanFilter
from filters.gaussian.mixture import Parts, blender, weigher
from filters.pages.equations import Equations, PagedModel
from filters.pages.kernels import anything_measured, nothing_to_summarise, page_kernels, prior_start
from filters.pages.memory import RowMemory
from filters.pages.programs import programs_of, stored, together, works_of
from filters.pages.stages import Stage
from thruster_env.core.compiled import inlined
from thruster_env.model.shape import Functions, Shape

Shapes = tuple[tuple[str, tuple[int, ...]], ...]  # of parameters, by name


class MixturePage(NamedTuple):
    """What a filter does with the parts of a mixture; `own` is what a part has by itself.

    With `predict` each part is predicted, and its weight is what the belief before says. Without it the belief is
    predicted, by the extended filter, and an update splits it and multiplies the weights by likelihoods.
    """

    begin: Callable  # begin(model, x, P), of the belief: the weights of all parts, and what else they share
    update: Callable  # update(model, own, *shared, x, P, z), of a part
    predict: Callable | None = None  # predict(model, own, *shared, x, P, u), of a part
    afresh: bool = True  # whether parts then begin with the belief, and not with what they were
    between: bool = True  # whether what lies between the parts counts in the covariance
    fixed: tuple[tuple[str, Any], ...] = ()  # what stands in `model.own` besides parameters


@lru_cache(maxsize=64)
def mixture_kernels(
    page: MixturePage, functions: Functions, shape: Shape, parameters: Shapes, count: int, own: tuple[int, ...]
) -> Kernels:
    """Kernels for `count` parts, each with numbers of its own in the shape `own`, behind the parameters of all.

    Extras: mean, covariance, innovation, its covariance and log-likelihood of each part; then the weights.
    """
    n, m, places, prior = shape.n, shape.m, memory_places(shape.n, shape.m), prior_start(shape)
    belief, length, wide = n + n * n, prod(own), max(shape.inputs, m)
    level = belief + m + m * m
    parts = Parts(places.extras, level + 1, count)
    first, stride, _ = parts
    weights = first + count * stride
    given = weights + count  # u or z, what a part has of its own, what all share
    plain = ExtendedKalmanFilter.page._replace(own=parameters, fixed=page.fixed)
    memory = RowMemory(shape, plain)
    memory.end = given + wide + length
    begun = together(page.begin(PagedModel(memory), memory.x, memory.P))
    shared = [memory.another(one) for one in begun[1:]]
    told = (places.innovation, m), (places.innovation_cov, m, m)
    v, S = (memory.read("rows", *one) for one in told)
    begin, density = works_of(
        stored(begun, (weights, *shared)),
        stored((log_density(v, S, present(memory.z)),), (places.log_likelihood,)),
    )

    def stages(memory: RowMemory, model: Equations) -> list[Stage]:
        x, P = memory.read("rows", 0, n), memory.read("rows", n, n, n, symmetric=True)
        u, z, of_part = memory.u, memory.z, [memory.read("given", wide, *own)]
        of_part += [memory.read("given", one.operation.at - given, *one.shape) for one in shared]
        moved = page.predict(model, *of_part, x, P, u) if page.predict else ()
        found, told = page.update(model, *of_part, x, P, z), (x, P, belief, belief + m, level)
        return [stored(moved, (x, P)[: len(moved)]), stored(found, told[: len(found)])]

    predict_part, update_part = programs_of(plain, functions, shape, stages).works
    of_states = blender(parts, n, 0, n, shape.state_angles, between=page.between)
    of_innovations = blender(
        *(parts, m, belief, belief + m, shape.measurement_angles), between=page.between, wraps=False
    )
    weigh, of_belief = weigher(parts, level), page_kernels(ExtendedKalmanFilter.page, functions, shape)
    step_place, innovation_place, likelihood_place = places.step, places.innovation, places.log_likelihood
    own_first, end, afresh = own_place(shape) + plain.own_size, memory.end, page.afresh

    @inlined
    def begin_afresh(row):
        for k in range(count):
            for i in range(belief):
                row[first + k * stride + i] = row[i]

    def each(work: Callable) -> Callable:
        @inlined
        def run(row, values, numbers):
            for i in range(values.shape[0]):
                row[given + i] = values[i]
            for k in range(count):
                for i in range(length):
                    row[given + wide + i] = numbers[own_first + k * length + i]
                work(row[first + k * stride : first + (k + 1) * stride], row[given:end], numbers)

        return run

    predict_each, update_each = each(predict_part), each(update_part)

    @inlined
    def start(memory, numbers, size):
        row, _, _ = memory
        prior(memory, numbers, size)
        for i in range(first, end):
            row[i] = 0.0

    @inlined
    def start_parts(memory, numbers, size):
        start(memory, numbers, size)
        begin_afresh(memory[0])
        begin(memory[0], memory[0], numbers)

    @inlined
    def predict(memory, u, numbers, size):
        row, _, _ = memory
        begin(row, u, numbers)
        if afresh:
            begin_afresh(row)
        predict_each(row, u, numbers)
        of_states(row, weights, 0)
        row[step_place] += 1.0

    @inlined
    def update(memory, z, numbers, size):
        row, _, _ = memory
        update_each(row, z, numbers)
        of_innovations(row, weights, innovation_place)
        density(row, z, numbers)
        of_states(row, weights, 0)

    @inlined
    def split_and_update(memory, z, numbers, size):
        row, _, _ = memory
        begin(row, z, numbers)
        begin_afresh(row)
        update_each(row, z, numbers)
        of_innovations(row, weights, innovation_place)
        row[likelihood_place] = 0.0
        if anything_measured(z):
            row[likelihood_place] = weigh(row, weights)
            of_states(row, weights, 0)

    works = (start_parts, predict, update) if page.predict else (start, of_belief.predict, split_and_update)
    return Kernels(*(n, m, n, 0, *works, nothing_to_summarise), extras=given - first, scratch=end - given)
