"""A page as kernels of the engine: what it says of matrices, worked out in the memory of a belief.

The first is called once, the second for each parameter. What slopes need of the values is worked out with them
and kept in memory: in the graph of the slopes it is what does not depend on a parameter, and is an argument of
what does.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cache, lru_cache, partial
from math import prod
from typing import Any, NamedTuple

import numpy as np

from filters.algebra.calls import arguments_of, calls_of
from filters.algebra.matrices import Matrix, Operation, evaluate, in_order
from filters.algebra.operations import present
from filters.algebra.scalars import slopes_of
from filters.engine.belief import Kernels, memory_places, row_access
from filters.pages.equations import Equations, PagedModel
from filters.pages.page import Page, RowMemory
from filters.pages.traced import MOST
from thruster_env.core.compiled import inlined
from thruster_env.core.sources import matrix_reader, vector_reader
from thruster_env.graphs.graphs import CONDITIONS, Graph, Number, needed_by, uncollected
from thruster_env.graphs.programs import ARRAYS, BY_MEMBERS, OF_STEPS, Place, callable_of, program_of
from thruster_env.model.shape import LANES, Functions, Shape, constants_reader, number_places

# A stage of a filter with derivatives: two functions, of which one works out values, the other slopes of these.


OF_PARAMETER = ("change", "move")  # arrays whose numbers are those of a parameter
FREE = ("given", "constant", *CONDITIONS)  # operations whose results are at hand, or cannot be kept as floats


class Stage(NamedTuple):
    """What a stage leaves in memory: values in `rows`, and in `change` what is a parameter's."""

    values: dict[int | Place, Matrix]
    slopes: dict[int, Matrix]

    @property
    def of_rows(self) -> dict[int, Matrix]:
        """Values by their places in `rows`, where all are of a filter without an ensemble."""
        return {at.at if isinstance(at, Place) else at: one for at, one in self.values.items()}

    @property
    def stores(self) -> tuple[list[tuple[Place, Matrix]], list[tuple[Place, Matrix]]]:
        """Places of all values, then of all slopes."""
        values = [(at if isinstance(at, Place) else Place("rows", at), one) for at, one in self.values.items()]
        return values, [(Place("change", at), one) for at, one in self.slopes.items()]


def stage_of(values: Mapping[int, Matrix], slopes: Mapping[int, Matrix], moves: Mapping[Matrix, Matrix]) -> Stage:
    """A stage that stores matrices at some places, and slopes of matrices at others."""
    found = slopes_of(list(slopes.values()), moves)
    kept: dict[int | Place, Matrix] = {at: one for at, one in values.items()}
    return Stage(kept, {at: one for at, one in zip(slopes, found, strict=True) if one is not None})


class Made(NamedTuple):
    """A stage as two functions or programs, and how much of memory they use."""

    values: Any
    slopes: Any
    length: int


def as_programs(stage: Stage, first: int, most: int) -> Made:
    """A stage as programs, whose kept numbers lie in rows from `first` on.

    Raises:
        TypeError: if a function cannot be traced, or there are more than `most` operations.
    """
    graph, wanted = Graph(most), [one for stores in stage.stores for _, one in stores]
    entries = iter(evaluate(wanted, numbers_of(wanted, graph.given)))
    values, slopes = (
        [
            (Place(array, start + k), graph.number(number))
            for (array, start), _ in stores
            for k, number in enumerate(np.ravel(np.array(next(entries), dtype=object)))
        ]
        for stores in stage.stores
    )
    slopes = [(place, number) for place, number in slopes if number.arguments != (place,)]
    order = needed_by([number for _, number in slopes])
    kept = _kept(order, lambda one: one.of, _of_parameter, lambda one: one.operation in FREE)
    rows = {number.place: Place("rows", first + k) for k, number in enumerate(kept)}
    values += [(rows[number.place], number) for number in kept]
    return Made(program_of(values, {}), program_of(slopes, rows), first + len(kept))


def numbers_of(wanted: Sequence[Matrix], number: Callable[..., Number]) -> dict[Matrix, Any]:
    """The entries `number(place)` of all matrices that are given of which some are made.

    Of a symmetric one those on and below the diagonal are read; of a member's `number` is told `member=True`.
    """
    return {one: _entries(one, number) for one in in_order(wanted) if isinstance(one.operation, Place)}


def _entries(one: Matrix, number: Callable[..., Number]) -> Any:
    array, start = one.operation
    found = np.empty(one.shape, dtype=object)
    for at in np.ndindex(*one.shape):
        there = tuple(sorted(at, reverse=True)) if one.symmetric else at
        place = Place(array, start + int(np.ravel_multi_index(there, one.shape)) if at else start)
        found[at] = number(place, member=True) if one.member else number(place)
    return found if one.shape else found[()]


def _of_parameter(one: Number | Matrix) -> bool:
    """Whether a number or matrix is given, for each parameter another one."""
    place = one.operation if isinstance(one, Matrix) else one.arguments[0] if one.operation == "given" else None
    return isinstance(place, Place) and place.array in OF_PARAMETER


def _kept(order: Sequence, of: Callable, of_parameter: Callable, free: Callable) -> list:
    """What is no parameter's among the arguments of what is; what is free is worked out anew, of what is kept."""
    moving: set[int] = set()
    found: dict[int, Any] = {}

    def keep(one) -> None:
        if free(one):
            for argument in of(one):
                keep(argument)
        else:
            found[id(one)] = one

    for one in order:
        if of_parameter(one) or any(id(a) in moving for a in of(one)):
            moving.add(id(one))
            for argument in of(one):
                if id(argument) not in moving:
                    keep(argument)
    return list(found.values())


def as_calls(
    stage: Stage,
    first: int,
    functions: Mapping[Operation, Callable],
    readers: Mapping,
    arrays: Sequence[str] = ARRAYS,
) -> Made:
    """A stage as functions that call others, whose kept matrices lie in rows from `first` on."""
    values, slopes = stage.stores
    slopes = [(place, one) for place, one in slopes if one.operation != place]
    order = in_order([one for _, one in slopes], (), arguments_of)
    kept = _kept(order, arguments_of, _of_parameter, lambda one: one.operation is present or not one.of)
    rows = {}
    for one in kept:
        rows[one] = Place("rows", first)
        first += prod(one.shape)
    known = {one: one.operation for one in in_order([one for _, one in values + slopes]) if not one.of} | dict(
        readers
    )
    values = values + [(place, one) for one, place in rows.items()]
    of_values = calls_of(values, known, functions, arrays)
    return Made(of_values, calls_of(slopes, known | rows, functions, arrays), first)


# Stages of a page as programs, or, of models that cannot be traced, as calls.


class Programs(NamedTuple):
    """Stages as functions (rows, given, numbers)."""

    memory: RowMemory
    works: Sequence[Callable]
    vectors: tuple[Callable, ...]  # the same for eight beliefs side by side; none if stages are calls


@uncollected()
def programs_of(
    page: Page, functions: Functions, shape: Shape, stages: Callable[[RowMemory, Equations], Sequence[Stage]]
) -> Programs:
    """Stages of a filter with some page, for a model's functions and shape.

    They are programs without calls where the functions can be traced and a stage has at most some ten thousand
    operations; else each operation on matrices is a call of a function for its sizes, and so is the model.
    """
    try:
        memory, model = _seen(page, functions, shape, trace=True)
        # The update, the largest stage, comes first: one that is too large shows at once.
        programs = [as_programs(one, 0, MOST).values for one in stages(memory, model)[::-1]][::-1]
        works = [callable_of(program, 1, OF_STEPS) for program in programs]
        return Programs(memory, works, tuple(callable_of(program, LANES, OF_STEPS) for program in programs))
    except Exception:  # whatever a user's function raises of numbers that it does not know: it is called, then
        memory, model = _seen(page, functions, shape, trace=False)
        made, readers = stages(memory, model), {memory.constants: constants_reader(shape)}
        works = [as_calls(one, 0, model.called, readers, OF_STEPS).values for one in made]
        return Programs(memory, works, ())


@uncollected()
def works_of(*stages: Stage) -> list[Callable]:
    """Stages without a model as functions (rows, given, numbers): programs, or calls where these are too long."""
    try:
        return [callable_of(as_programs(one, 0, MOST).values, 1, OF_STEPS) for one in stages]
    except TypeError:
        return [as_calls(one, 0, {}, {}, OF_STEPS).values for one in stages]


def _seen(page: Page, functions: Functions, shape: Shape, *, trace: bool) -> tuple[RowMemory, Equations]:
    memory = RowMemory(shape, page)
    return memory, Equations(functions, memory, constants_move=False, trace=trace)


def stored(
    results: tuple, targets: Sequence[Matrix | Place | int], kept: Mapping[str, Matrix] | None = None
) -> Stage:
    """The stage that leaves results of a page where some matrices lie, or at places.

    Args:
        results: matrices, behind which a dictionary may say what changes of what is kept.
        targets: where they are to lie.
        kept: where what is kept lies.
    """
    *values, changed = with_kept(results)
    places = [*targets, *((kept or {})[name] for name in changed)]
    stores: dict[int | Place, Matrix] = {}
    for place, value in zip(places, (*values, *changed.values()), strict=True):
        if isinstance(place, Matrix):
            if place.symmetric and not value.symmetric or place.shape != value.shape:
                raise TypeError(f"a page must return the symmetric part of {value!r}, by sym, and {place.shape}")
            place = place.operation
        if value.member and not (isinstance(place, Place) and place.array in BY_MEMBERS):
            raise TypeError(f"a page must return {value!r} of all members, such as a mean, not of each")
        stores[place] = value
    return Stage(stores, {})


def with_kept(results: Any) -> tuple:
    """What a page returns, with what changes of what is kept behind it."""
    found = together(results)
    return found if found and isinstance(found[-1], dict) else (*found, {})


def together(results: Any) -> tuple:
    """What a page returns, as a tuple."""
    return results if isinstance(results, tuple) else (results,)


def stages_of(page: Page, memory: RowMemory, model: PagedModel) -> list[Stage]:
    """What a page stores: at the start, where a prediction begins, in each substep, at its end, in an update."""
    places, x, p = memory_places(memory.shape.n, memory.shape.m), memory.x, memory.P
    started = page.started(model)
    model.extras = memory.keep(started)
    begun = (x, p) if page.represent is None else together(page.represent(model, x, p))
    flying = (x, p) if page.represent is None else [memory.another(one) for one in begun]
    advanced = together(page.propagate(model, *flying, memory.u))
    told = places.innovation, places.innovation_cov, places.log_likelihood
    return [
        stored((started,), (), memory.kept),
        Stage({}, {}) if page.represent is None else stored(begun, flying),
        stored(advanced, flying, memory.kept),
        stored(page.add_process_noise(model, *flying), (x, p), memory.kept),
        stored(page.update(model, x, p, memory.z), (x, p, *told), memory.kept),
    ]


@lru_cache(maxsize=64)
def page_kernels(page: Page, functions: Functions, shape: Shape) -> Kernels:
    """Kernels of a page for a model's functions and shape."""
    n, m = shape.n, shape.m
    memory, works, vectors = programs_of(page, functions, shape, partial(stages_of, page))
    start, begin, advance, settle, correct = works
    places, kept = memory_places(n, m), sum(prod(one.shape) for one in memory.kept.values())
    prior, step_place, substeps_place = prior_start(shape), places.step, number_places(n, m).substeps

    @inlined
    def begin_belief(memory, numbers, size):
        prior(memory, numbers, size)
        start(memory[0], numbers, numbers)

    @inlined
    def predict(memory, u, numbers, size):
        row, _, _ = memory
        begin(row, u, numbers)
        for _ in range(int(numbers[substeps_place])):
            advance(row, u, numbers)
        settle(row, u, numbers)
        row[step_place] += 1.0

    @inlined
    def update(memory, z, numbers, size):
        correct(memory[0], z, numbers)

    return Kernels(
        *(n, m, n, 0, begin_belief, predict, update, nothing_to_summarise),
        extras=kept,
        scratch=memory.end - places.extras - kept,
        vectors=vectors[1:],
    )


@cache
def prior_start(shape: Shape) -> Callable:
    """Return `start(memory, numbers, size)`: mean and covariance are those of the prior."""
    n, m = shape.n, shape.m
    source = number_places(n, m)
    read_mean, read_cov = vector_reader(n, source.prior_mean), matrix_reader(n, n, source.prior_cov)
    _, (store_mean, store_cov), _ = row_access(shape)

    @inlined
    def start(memory, numbers, size):
        row, _, _ = memory
        store_mean(row, read_mean(numbers))
        store_cov(row, read_cov(numbers))

    return start


@inlined
def nothing_to_summarise(memory, size):
    """Mean and covariance are the belief itself."""


@inlined
def anything_measured(z):
    """Whether a channel of z is present."""
    for i in range(z.shape[0]):
        if z[i] == z[i]:
            return True
    return False
