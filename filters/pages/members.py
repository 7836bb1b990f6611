"""A page of an ensemble filter as kernels of the engine: equations of a member are evaluated for each member."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from math import prod
from typing import NamedTuple

from filters.algebra.matrices import Matrix, in_order, input_matrix
from filters.algebra.members import covariance, mean, on_branch
from filters.algebra.operations import quotient, wrap
from filters.engine.belief import Kernels, memory_places, own_place
from filters.pages.equations import Equations, PagedModel
from filters.pages.kernels import Stage, as_calls, as_programs, stored, with_extras
from filters.pages.page import NumbersMemory, Page
from thruster_env.core.compiled import inlined
from thruster_env.core.streams import FILTER_MEASUREMENT, FILTER_PRIOR, FILTER_PROCESS, fill_normals
from thruster_env.graphs.graphs import TooLarge
from thruster_env.graphs.loops import cut
from thruster_env.graphs.programs import OF_MEMBERS, Place, callable_of
from thruster_env.model.shape import LANES, Functions, Shape, constants_reader, number_places

# Operations and sums of a stage; with more, programs without calls take longer to compile than calls.
MOST, MOST_SUMS = 14_000, 600


class MembersMemory(NumbersMemory):
    """The memory of an ensemble.

    rows     the row of `filters.engine.belief`, with the filter's extras
    given    u or z
    numbers  the model's, then the filter's own
    table    a row for each component of the members x, then scratch
    draws    standard normals, w of the process or e of the measurement: a row for each component
    """

    def __init__(self, shape: Shape, page: Page):
        row = memory_places(shape.n, shape.m)
        x = input_matrix(Place("table", 0), (shape.n,), member=True)
        p = input_matrix(Place("rows", row.cov), (shape.n, shape.n), symmetric=True, like=x)
        super().__init__(shape, page, x, p, own_place(shape))
        self.u, self.z = self.read("given", 0, shape.inputs), self.read("given", 0, shape.m)
        self.ratio = self.ratio_in("given", 0)
        self.w, self.e = (
            input_matrix(Place("draws", 0), (size,), member=True, like=x) for size in (shape.n, shape.m)
        )
        self.mean = self.read("rows", row.mean, shape.n)


def stages_of(page: Page, memory: MembersMemory, model: PagedModel) -> dict[str, Stage]:
    """Stages of a page by name: the start, a substep, the end of a step, the update, and the belief's moments."""
    x, layout = memory.x, memory_places(memory.shape.n, memory.shape.m)
    outputs = layout.innovation, layout.innovation_cov, layout.log_likelihood
    prior = on_branch(model.prior_mean + model.prior_root @ memory.w, model.state_angles)
    started = page.started(model)
    extras = model.extras = memory.keep(started)
    updated, *rest, changed = with_extras(page.update(model, x, memory.z, memory.e))
    of_belief = memory.mean, memory.P
    return {
        "start": stored((prior, started), (x,), extras),
        "advance": stored((page.propagate(model, x, memory.u),), (x,)),
        "settle": stored((page.add_process_noise(model, x, memory.w),), (x,)),
        "analyse": stored((updated,), (x,)),
        "update": stored((updated, *rest, *moments(model, updated), changed), (x, *outputs, *of_belief), extras),
        "summarise": stored(moments(model, x), of_belief),
    }


def moments(model: PagedModel, x: Matrix) -> tuple[Matrix, Matrix]:
    """The mean and the covariance of the members."""
    return wrap(mean(x), model.state_angles), covariance(x, x)


class Works(NamedTuple):
    """A stage as a function (rows, given, numbers, table, draws, size)."""

    work: Callable
    rows: int  # of the table that it uses
    draws: int  # rows of draws that it uses


@lru_cache(maxsize=64)
def works_of(
    page: Page, functions: Functions, shape: Shape, stages: Callable = stages_of, first: int | None = None
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
    return sums > MOST_SUMS or quotients > MOST


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
    program = as_programs(stage, 0, MOST).values
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
    return _correction(works_of(page, functions, shape)["analyse"], shape)


def _correction(work: Works, shape: Shape) -> Callable:
    layout, m = memory_places(shape.n, shape.m), shape.m
    correct, _, draws_noise = work
    step, key_0, key_1 = layout.step, layout.key_0, layout.key_1

    @inlined
    def update(memory, z, numbers, size):
        row, table, draws = memory
        correct(row, z, numbers, table, draws, size)

    @inlined
    def update_with_noise(memory, z, numbers, size):
        row, table, draws = memory
        fill_normals(draws, m * table.shape[1], row[step], FILTER_MEASUREMENT, row[key_0], row[key_1])
        correct(row, z, numbers, table, draws, size)

    return update_with_noise if draws_noise else update


def extras_size(page: Page, shape: Shape) -> int:
    """Count of a page's extras: numbers that it keeps besides the members."""
    return sum(prod(matrix.shape) for matrix in page.started(PagedModel(MembersMemory(shape, page))).values())


def predictor(works: dict[str, Works], shape: Shape) -> Callable:
    """Return `predict(memory, u, numbers, size)`: propagate members in all substeps, then add process noise."""
    layout, substeps = memory_places(shape.n, shape.m), number_places(shape.n, shape.m).substeps
    advance, (add_process_noise, _, drawn) = works["advance"].work, works["settle"]
    step, key_0, key_1 = layout.step, layout.key_0, layout.key_1

    @inlined
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
    n, m, works = shape.n, shape.m, works_of(page, functions, shape)
    draw_prior, moments_of, layout = works["start"].work, works["summarise"].work, memory_places(n, m)
    step, key_0, key_1 = layout.step, layout.key_0, layout.key_1

    @inlined
    def start(memory, numbers, size):
        row, table, draws = memory
        fill_normals(draws, n * table.shape[1], row[step], FILTER_PRIOR, row[key_0], row[key_1])
        draw_prior(row, numbers, numbers, table, draws, size)

    @inlined
    def summarise(memory, size):
        row, table, draws = memory
        moments_of(row, row, row, table, draws, size)

    update, rows = _correction(works["update"], shape), max(work.rows for work in works.values())
    return Kernels(
        n, m, rows, max(n, m), start, predictor(works, shape), update, summarise, extras=extras_size(page, shape)
    )
