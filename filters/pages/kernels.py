"""A page as kernels of the engine: its equations of matrices, evaluated in the memory of a belief.

A stage of a filter with derivatives is two functions. The first computes values and is called once; the second
computes their slopes and is called once for each parameter. The first also stores intermediate results that the
slopes need: the arguments, in the graph of the slopes, of operations that depend on a parameter, if they do not
depend on one themselves.

A page of an ensemble filter as kernels of the engine: equations of a member are evaluated for each member.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cache, lru_cache, partial
from math import prod
from typing import Any, NamedTuple

import numpy as np

from filters.algebra.calls import arguments_of, calls_of
from filters.algebra.matrices import Matrix, Operation, evaluate, in_order, input_matrix
from filters.algebra.members import on_branch
from filters.algebra.operations import present, quotient, slopes_of
from filters.algebra.tangents import local_at, moved
from filters.engine.belief import Kernels, filter_offset, memory_offsets
from filters.pages.charts import measured_about_mean, moments, on_tangent
from filters.pages.page import Equations, NumbersMemory, Page, PagedModel, RowMemory, acting_places
from thruster_env.core.angles import wrapped
from thruster_env.core.streams import FILTER_MEASUREMENT, FILTER_PRIOR, FILTER_PROCESS, fill_normals
from thruster_env.graphs.graphs import CONDITIONS, Graph, Number, TooLarge, needed_by, uncollected
from thruster_env.graphs.programs import (
    ARRAYS,
    BY_MEMBERS,
    OF_MEMBERS,
    OF_STEPS,
    Place,
    callable_of,
    cut,
    program_of,
)
from thruster_env.model.shape import LANES, Functions, Shape, constants_reader
from thruster_env.model.traced import MOST, most_operations

OF_PARAMETER = ("change", "move")  # arrays that differ between parameters
FREE = ("given", "constant", *CONDITIONS)  # operations whose results are in memory, or cannot be stored as floats


class Stage(NamedTuple):
    """What a stage stores: values in `rows`, and slopes along a parameter in `change`."""

    values: dict[int | Place, Matrix]
    slopes: dict[int, Matrix]

    @property
    def of_rows(self) -> dict[int, Matrix]:
        """Values by their offsets in `rows`, of a filter without an ensemble."""
        return {at.at if isinstance(at, Place) else at: matrix for at, matrix in self.values.items()}

    @property
    def stores(self) -> tuple[list[tuple[Place, Matrix]], list[tuple[Place, Matrix]]]:
        """All values with the places where they are stored, then all slopes."""
        values = [
            (at if isinstance(at, Place) else Place("rows", at), matrix) for at, matrix in self.values.items()
        ]
        return values, [(Place("change", at), matrix) for at, matrix in self.slopes.items()]


def stage_of(values: Mapping[int, Matrix], slopes: Mapping[int, Matrix], moves: Mapping[Matrix, Matrix]) -> Stage:
    """A stage that stores matrices at some places, and slopes of matrices at others."""
    derivatives = slopes_of(list(slopes.values()), moves)
    stores: dict[int | Place, Matrix] = {at: matrix for at, matrix in values.items()}
    return Stage(stores, {at: slope for at, slope in zip(slopes, derivatives, strict=True) if slope is not None})


class StageWork(NamedTuple):
    """A stage as two functions or programs, and the length of `rows` that they use."""

    values: Any
    slopes: Any
    length: int


def as_programs(stage: Stage, first: int, most: int) -> StageWork:
    """A stage as programs, which store intermediate results in `rows` from `first` on.

    Raises:
        TypeError: if a function cannot be traced, or there are more than `most` operations.
    """
    graph, wanted = Graph(most), [matrix for stores in stage.stores for _, matrix in stores]
    entries = iter(evaluate(wanted, numbers_of(wanted, graph.given)))
    values, slopes = (
        [
            (Place(array, start + k), graph.number(number))
            for (array, start), _ in stores
            for k, number in enumerate(np.ravel(np.array(next(entries), dtype=object)))
        ]
        for stores in stage.stores
    )
    slopes = [(position, number) for position, number in slopes if number.arguments != (position,)]
    order = needed_by([number for _, number in slopes])
    retained = _fixed_arguments(
        order, lambda number: number.of, _of_parameter, lambda number: number.operation in FREE
    )
    rows = {number.place: Place("rows", first + k) for k, number in enumerate(retained)}
    values += [(rows[number.place], number) for number in retained]
    return StageWork(program_of(values, {}), program_of(slopes, rows), first + len(retained))


def numbers_of(wanted: Sequence[Matrix], number: Callable[..., Number]) -> dict[Matrix, Any]:
    """The entries `number(place)` of all given matrices on which `wanted` depend.

    Of a symmetric matrix only entries on and below the diagonal are read; for one of a member, `number` gets
    `member=True`.
    """
    return {matrix: _entries(matrix, number) for matrix in in_order(wanted) if isinstance(matrix.operation, Place)}


def _entries(matrix: Matrix, number: Callable[..., Number]) -> Any:
    array, start = matrix.operation
    entries = np.empty(matrix.shape, dtype=object)
    for at in np.ndindex(*matrix.shape):
        index = tuple(sorted(at, reverse=True)) if matrix.symmetric else at
        position = Place(array, start + int(np.ravel_multi_index(index, matrix.shape)) if at else start)
        entries[at] = number(position, member=True) if matrix.member else number(position)
    return entries if matrix.shape else entries[()]


def _of_parameter(node: Number | Matrix) -> bool:
    """Whether a number or matrix is read from an array that differs between parameters."""
    position = (
        node.operation if isinstance(node, Matrix) else node.arguments[0] if node.operation == "given" else None
    )
    return isinstance(position, Place) and position.array in OF_PARAMETER


def _fixed_arguments(order: Sequence, of: Callable, of_parameter: Callable, free: Callable) -> list:
    """Arguments of operations that depend on a parameter, which do not depend on one themselves.

    Free ones are computed again instead of stored, so their own arguments take their place.
    """
    moving: set[int] = set()
    fixed: dict[int, Any] = {}

    def keep(node) -> None:
        if free(node):
            for argument in of(node):
                keep(argument)
        else:
            fixed[id(node)] = node

    for node in order:
        if of_parameter(node) or any(id(a) in moving for a in of(node)):
            moving.add(id(node))
            for argument in of(node):
                if id(argument) not in moving:
                    keep(argument)
    return list(fixed.values())


def as_calls(
    stage: Stage,
    first: int,
    functions: Mapping[Operation, Callable],
    readers: Mapping,
    arrays: Sequence[str] = ARRAYS,
) -> StageWork:
    """A stage as functions that call others, which store intermediate matrices in `rows` from `first` on."""
    values, slopes = stage.stores
    slopes = [(position, matrix) for position, matrix in slopes if matrix.operation != position]
    order = in_order([matrix for _, matrix in slopes], (), arguments_of)
    retained = _fixed_arguments(
        order, arguments_of, _of_parameter, lambda matrix: matrix.operation is present or not matrix.of
    )
    rows = {}
    for matrix in retained:
        rows[matrix] = Place("rows", first)
        first += prod(matrix.shape)
    known = {matrix: matrix.operation for matrix in in_order([y for _, y in values + slopes]) if not matrix.of}
    known |= readers
    values = values + [(position, matrix) for matrix, position in rows.items()]
    of_values = calls_of(values, known, functions, arrays)
    return StageWork(of_values, calls_of(slopes, known | rows, functions, arrays), first)


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

    They are programs without calls if the functions can be traced and a stage has at most some ten thousand
    operations. Otherwise each operation on matrices is a call of a function for its sizes, and so is the model.
    """
    try:
        memory, model = _memory_and_model(page, functions, shape, trace=True)
        # The update, the largest stage, comes first: if it is too large, no time is spent on the others.
        most = most_operations(shape)
        programs = [as_programs(stage, 0, most).values for stage in stages(memory, model)[::-1]][::-1]
        works = [callable_of(program, 1, OF_STEPS) for program in programs]
        return Programs(memory, works, tuple(callable_of(program, LANES, OF_STEPS) for program in programs))
    except Exception:  # whatever a user's function raises if it gets Numbers: then it is called instead
        memory, model = _memory_and_model(page, functions, shape, trace=False)
        stage_list, readers = stages(memory, model), {memory.constants: constants_reader(shape)}
        works = [as_calls(stage, 0, model.called, readers, OF_STEPS).values for stage in stage_list]
        return Programs(memory, works, ())


@uncollected()
def works_of(*stages: Stage) -> list[Callable]:
    """Stages without a model as functions (rows, given, numbers): a program each, or calls if that is too long."""
    works = []
    for stage in stages:
        try:
            works.append(callable_of(as_programs(stage, 0, MOST).values, 1, OF_STEPS))
        except TypeError:  # `TooLarge`
            works.append(as_calls(stage, 0, {}, {}, OF_STEPS).values)
    return works


def _memory_and_model(
    page: Page, functions: Functions, shape: Shape, *, trace: bool
) -> tuple[RowMemory, Equations]:
    memory = RowMemory(shape, page)
    return memory, Equations(functions, memory, constants_move=False, trace=trace)


def stored(
    results: tuple, targets: Sequence[Matrix | Place | int], extras: Mapping[str, Matrix] | None = None
) -> Stage:
    """The stage that stores results of a page.

    Args:
        results: matrices, then perhaps a dictionary of extras that change.
        targets: for each matrix of the results a place, or a matrix whose place it takes.
        extras: all extras, by name, as they are read from memory.
    """
    *values, changed = with_extras(results)
    positions = [*targets, *((extras or {})[name] for name in changed)]
    stores: dict[int | Place, Matrix] = {}
    for position, value in zip(positions, (*values, *changed.values()), strict=True):
        if isinstance(position, Matrix):
            if position.shape != value.shape:
                raise TypeError(f"a page must return {position!r} with its shape, but got {value!r}")
            if position.symmetric and not value.symmetric:
                raise TypeError(f"a page must return the symmetric part, sym(P), but got {value!r}")
            position = position.operation
        if value.member and not (isinstance(position, Place) and position.array in BY_MEMBERS):
            raise TypeError(f"a page must return {value!r} of all members, such as a mean, not of each")
        stores[position] = value
    return Stage(stores, {})


def with_extras(results: Any) -> tuple:
    """The results of a page, then a dictionary of the extras that change, empty if it returns none."""
    values = as_tuple(results)
    return values if values and isinstance(values[-1], dict) else (*values, {})


def pure(function: Callable, *arguments: Any) -> Any:
    """What a page's function returns; ValueError if a second call returns something else, as by a random draw."""
    results, again = function(*arguments), function(*arguments)
    *values, extras = with_extras(results)
    *same, same_extras = with_extras(again)
    pairs = zip((*values, *extras.values()), (*same, *same_extras.values()), strict=True)
    if any(a is not b for a, b in pairs):
        rule = "must depend on its arguments alone: an ensemble's page is given its random numbers"
        raise ValueError(f"{function.__name__} of a page {rule}, but two calls differ")
    return results


def updated(results: Any, *before: Matrix, m: int) -> tuple:
    """What `update` of a page returns: the belief, v, S, the log density, and the extras that change.

    Args:
        results: x, P, v, S and the log density, or of an ensemble x, v, S and the log density.
        before: the belief before the update.
        m: number of measurements.

    Raises:
        ValueError: if it returns another number of values, or v, S or the density of another shape.
    """
    values, outputs = with_extras(results), ("the innovation v", "its covariance S", "its log density")
    if len(values) != len(before) + 4:
        rule = f"update of a page must return {'x, P' if len(before) == 2 else 'x'}, {', '.join(outputs[:2])} and"
        raise ValueError(
            f"{rule} {outputs[2]}, and perhaps a dictionary, but it returned {len(values) - 1} values"
        )
    for name, value, shape in zip(outputs, values[len(before) :], ((m,), (m, m), ()), strict=False):
        if not isinstance(value, Matrix) or value.shape != shape:
            last = ", log_density(v, S, present(z))" if shape == () else ""
            raise ValueError(f"update of a page must return {name}{last} of shape {shape}, but got {value!r}")
    return values


def as_tuple(results: Any) -> tuple:
    """The results of a page, one or several, as a tuple."""
    return results if isinstance(results, tuple) else (results,)


def stages_of(page: Page, memory: RowMemory, model: PagedModel) -> list[Stage]:
    """Stages of a page: the start; the representation, a substep and the end of a prediction; the update."""
    shape, x, p = memory.shape, memory.x, memory.P
    layout = memory_offsets(shape.n, shape.m, shape.t)
    started = page.started(model)
    model.extras = memory.keep(started)
    begun = (x, p) if page.represent is None else as_tuple(page.represent(model, x, p))
    predicted = (x, p) if page.represent is None else [memory.another(matrix) for matrix in begun]
    advanced = page.propagated(model, *predicted, u=memory.u)
    outputs = layout.innovation, layout.innovation_cov, layout.log_likelihood
    local, z = local_at(model, memory.z, x)
    corrected = updated(pure(page.update, local, x, p, z), x, p, m=shape.m)
    return [
        stored((started,), (), memory.extras),
        Stage({}, {}) if page.represent is None else stored(begun, predicted),
        stored(advanced, predicted, memory.extras),
        stored(pure(page.add_process_noise, model, *predicted), (x, p), memory.extras),
        stored(corrected, (x, p, *outputs), memory.extras),
    ]


@lru_cache(maxsize=64)
def page_kernels(page: Page, functions: Functions, shape: Shape) -> Kernels:
    """Kernels of a page for a model's functions and shape."""
    n, m = shape.n, shape.m
    memory, works, vectors = programs_of(page, functions, shape, partial(stages_of, page))
    start_extras, represent, advance, add_process_noise, correct = works
    layout = memory_offsets(n, m, shape.t)
    extras_size = sum(prod(matrix.shape) for matrix in memory.extras.values())
    prior, step_offset, substeps_offset = prior_start(shape), layout.step, shape.offsets.substeps

    def begin_belief(memory, numbers, size):
        prior(memory, numbers, size)
        start_extras(memory[0], numbers, numbers)

    def predict(memory, u, numbers, size):
        row, _, _ = memory
        represent(row, u, numbers)
        for _ in range(int(numbers[substeps_offset])):
            advance(row, u, numbers)
        add_process_noise(row, u, numbers)
        row[step_offset] += 1.0

    def update(memory, z, numbers, size):
        correct(memory[0], z, numbers)

    return Kernels(
        *(n, m, n, 0, begin_belief, predict, update, nothing_to_summarise),
        extras=extras_size,
        scratch=memory.end - layout.extras - extras_size,
        turns=len(shape.turns),
        measured_turns=len(shape.measured_turns),
        vectors=vectors[1:],
        acting=acting_places(memory.extras),
    )


@cache
def prior_start(shape: Shape) -> Callable:
    """Return `start(memory, numbers, size)`: mean and covariance are those of the prior."""
    n, t, source, angles = shape.n, shape.t, shape.offsets, shape.state_angles
    layout, has_angles = memory_offsets(n, shape.m, t), any(angles)
    mean, cov, prior_mean, prior_cov = layout.mean, layout.cov, source.prior_mean, source.prior_cov

    def start(memory, numbers, size):
        row, _, _ = memory
        for i in range(n):
            x = numbers[prior_mean + i]
            row[mean + i] = wrapped(x) if has_angles and angles[i] else x
        for i in range(t * t):
            row[cov + i] = numbers[prior_cov + i]

    return start


def nothing_to_summarise(memory, size):
    """Do nothing: mean and covariance are the belief itself."""


def anything_measured(z):
    """Whether a channel of z is present."""
    for i in range(z.shape[0]):
        if z[i] == z[i]:
            return True
    return False


# Operations and sums of a stage; with more, programs without calls take longer to compile than calls.
MOST_IN_MEMBERS, MOST_SUMS = 14_000, 600


class MembersMemory(NumbersMemory):
    """The memory of an ensemble.

    rows     the row of `filters.engine.belief`, with the filter's extras
    given    u or z
    numbers  the model's, then the filter's own
    table    a row for each component of the members x, then scratch
    draws    standard normals, w of the process or e of the measurement: a row for each component
    """

    def __init__(self, shape: Shape, page: Page):
        row = memory_offsets(shape.n, shape.m, shape.t)
        x = input_matrix(Place("table", 0), (shape.n,), member=True)
        p = input_matrix(Place("rows", row.cov), (shape.t, shape.t), symmetric=True, like=x)
        super().__init__(shape, page, x, p, filter_offset(shape))
        self.u, self.z = self.read("given", 0, shape.inputs), self.read("given", 0, shape.channels)
        self.ratio = self.ratio_in("given", 0)
        self.w, self.e = (
            input_matrix(Place("draws", 0), (size,), member=True, like=x) for size in (shape.t, shape.m)
        )
        self.mean = self.read("rows", row.mean, shape.n)


def member_stages_of(page: Page, memory: MembersMemory, model: PagedModel) -> dict[str, Stage]:
    """Stages of a page by name: the start, a substep, the end of a step, the update, and the belief's moments."""
    x, layout = memory.x, memory_offsets(memory.shape.n, memory.shape.m, memory.shape.t)
    page = measured_about_mean(page) if model.measured_turns else page
    page = on_tangent(page) if model.turns else page
    outputs = layout.innovation, layout.innovation_cov, layout.log_likelihood
    w = model.prior_root @ memory.w
    prior = moved(model.prior_mean, w, model.turns) if model.turns else model.prior_mean + w
    prior = on_branch(prior, model.state_angles)
    started = page.started(model)
    extras = model.extras = memory.keep(started)
    after, *rest, changed = updated(pure(page.update, model, x, memory.z, memory.e), x, m=memory.shape.m)
    of_belief = memory.mean, memory.P
    return {
        "start": stored((prior, started), (x,), extras),
        "propagate": stored(page.propagated(model, x, u=memory.u), (x,), extras),
        "add_process_noise": stored((page.add_process_noise(model, x, memory.w),), (x,)),
        "analyse": stored((after,), (x,)),
        "update": stored((after, *rest, *moments(model, after), changed), (x, *outputs, *of_belief), extras),
        "summarise": stored(moments(model, x), of_belief),
    }


class Works(NamedTuple):
    """A stage as a function (rows, given, numbers, table, draws, size)."""

    work: Callable
    rows: int  # of the table that it uses
    draws: int  # rows of draws that it uses


@lru_cache(maxsize=64)
def member_works_of(
    page: Page, functions: Functions, shape: Shape, stages: Callable = member_stages_of, first: int | None = None
) -> dict[str, Works]:
    """Stages of an ensemble's page, for a model's functions and shape.

    They are programs without calls, as `kernels.programs_of` makes them. Stages of a large model are calls, and so
    are those that need a function that cannot be traced. `stages(page, memory, model)` returns them by name; in
    the table's rows before `first`, by default n, they write only what they store.
    """
    memory, model, called = _stages_for(page, functions, shape, stages, trace=False)
    readers, first = {memory.constants: constants_reader(shape)}, shape.n if first is None else first
    if not _is_large(called["update"]):
        _, _, traced = _stages_for(page, functions, shape, stages, trace=True)
        try:
            return {name: _work_of(traced[name], stage, model, readers, first) for name, stage in called.items()}
        except TooLarge:
            pass
    return {name: _as_calls(stage, model, readers, first) for name, stage in called.items()}


def _is_large(stage: Stage) -> bool:
    """Whether a stage has so many sums over members and quotients C S^-1 that calls compile faster."""
    matrices = in_order(list(stage.values.values()))
    sums = sum(
        prod(matrix.shape) // (1 + matrix.symmetric)
        for matrix in matrices
        if getattr(matrix.operation, "reduces", False)
    )
    quotients = sum(
        2 * prod(matrix.shape) * matrix.shape[-1] for matrix in matrices if matrix.operation is quotient
    )
    return sums > MOST_SUMS or quotients > MOST_IN_MEMBERS


def _work_of(traced: Stage, called: Stage, model: Equations, readers: dict, first: int) -> Works:
    try:
        return of_members(traced, first)
    except TooLarge:
        raise
    except TypeError:  # a function that cannot be traced
        return _as_calls(called, model, readers, first)


def _stages_for(page: Page, functions: Functions, shape: Shape, stages: Callable, *, trace: bool):
    memory = MembersMemory(shape, page)
    model = Equations(functions, memory, constants_move=False, trace=trace, partly=True)
    return memory, model, stages(page, memory, model)


def of_members(stage: Stage, first: int) -> Works:
    """A stage as a program, which stores intermediate numbers of members in rows of the table from `first` on.

    Raises:
        TypeError: if a function cannot be traced, or there are too many operations.
    """
    program = as_programs(stage, 0, MOST_IN_MEMBERS).values
    work = callable_of(program, LANES, OF_MEMBERS, first)
    return Works(
        work,
        cut(program, first).rows,
        max((position.at + 1 for position, _ in program.reads if position.array == "draws"), default=0),
    )


def _as_calls(stage: Stage, model: Equations, readers: dict, first: int) -> Works:
    work = as_calls(stage, 0, model.called, readers, OF_MEMBERS).values
    inputs = [matrix for matrix in in_order(list(stage.values.values())) if isinstance(matrix.operation, Place)]
    draws = (matrix.operation.at + prod(matrix.shape) for matrix in inputs if matrix.operation.array == "draws")
    return Works(work, first, max(draws, default=0))


def analysis_of(page: Page, functions: Functions, shape: Shape) -> Callable:
    """Return `analyse(memory, z, numbers, size)`: update the members, without innovation and likelihood."""
    return _correction(member_works_of(page, functions, shape)["analyse"], shape)


def _correction(work: Works, shape: Shape) -> Callable:
    layout, m = memory_offsets(shape.n, shape.m, shape.t), shape.m
    correct, _, draws_noise = work
    step, key_0, key_1 = layout.step, layout.key_0, layout.key_1

    def update(memory, z, numbers, size):
        row, table, draws = memory
        if draws_noise:
            fill_normals(draws, m * table.shape[1], row[step], FILTER_MEASUREMENT, row[key_0], row[key_1])
        correct(row, z, numbers, table, draws, size)

    return update


def extras_size(page: Page, shape: Shape) -> int:
    """Count of a page's extras: numbers that it keeps besides the members."""
    return sum(prod(matrix.shape) for matrix in page.started(PagedModel(MembersMemory(shape, page))).values())


def predictor(works: dict[str, Works], shape: Shape) -> Callable:
    """Return `predict(memory, u, numbers, size)`: propagate members in all substeps, then add process noise."""
    layout, substeps = memory_offsets(shape.n, shape.m, shape.t), shape.offsets.substeps
    advance, (add_process_noise, _, drawn) = works["propagate"].work, works["add_process_noise"]
    step, key_0, key_1 = layout.step, layout.key_0, layout.key_1

    def predict(memory, u, numbers, size):
        row, table, draws = memory
        for _ in range(int(numbers[substeps])):
            advance(row, u, numbers, table, draws, size)
        row[step] += 1.0
        fill_normals(draws, drawn * table.shape[1], row[step], FILTER_PROCESS, row[key_0], row[key_1])
        add_process_noise(row, u, numbers, table, draws, size)

    return predict


@lru_cache(maxsize=64)
def members_kernels(page: Page, functions: Functions, shape: Shape) -> Kernels:
    """Kernels of an ensemble's page for a model's functions and shape."""
    n, m, works = shape.n, shape.m, member_works_of(page, functions, shape)
    draw_prior, moments_of, layout = works["start"].work, works["summarise"].work, memory_offsets(n, m, shape.t)
    step, key_0, key_1 = layout.step, layout.key_0, layout.key_1

    def start(memory, numbers, size):
        row, table, draws = memory
        fill_normals(draws, n * table.shape[1], row[step], FILTER_PRIOR, row[key_0], row[key_1])
        draw_prior(row, numbers, numbers, table, draws, size)

    def summarise(memory, size):
        row, table, draws = memory
        moments_of(row, row, row, table, draws, size)

    update, rows = _correction(works["update"], shape), max(work.rows for work in works.values())
    memory = MembersMemory(shape, page)
    acting = acting_places(memory.keep(page.started(PagedModel(memory))))
    parts = start, predictor(works, shape), update, summarise
    return Kernels(
        *(n, m, rows, max(n, m), *parts),
        extras=extras_size(page, shape),
        acting=acting,
        turns=len(shape.turns),
        measured_turns=len(shape.measured_turns),
    )
