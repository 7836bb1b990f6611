"""A page's stages as programs in C: a model's numbers are constants in them, so that zeros and ones vanish."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from math import prod
from typing import NamedTuple

import numpy as np

from filters.algebra.densities import dot
from filters.algebra.matrices import Matrix, evaluate
from filters.algebra.operations import factor, quotient
from filters.c.identifiers import is_macro, is_name
from filters.engine.layout import memory_places
from filters.ensembles.ensemble import EnsembleFilter
from filters.ensembles.page_is_all import check_page_is_all
from filters.filter import Filter
from filters.pages.equations import Equations
from filters.pages.kernels import stages_of
from filters.pages.members import MembersMemory
from filters.pages.members import stages_of as stages_of_members
from filters.pages.memory import RowMemory
from filters.pages.page_filter import FilterWithPage, with_page
from filters.pages.stages import numbers_of
from filters.pages.traced import MOST, Traced
from thruster_env.graphs.graphs import Graph, TooLarge
from thruster_env.graphs.programs import BY_MEMBERS, Place, Program, program_of
from thruster_env.model.shape import Shape
from thruster_env.model.state_space import StateSpaceModel

NIS = -1  # its place in a row, where machine code has none
TOLD = frozenset(  # of each filter in C, and by its tests
    "x P innovation S nis log_likelihood channels restarts channel healthy tested alarmed".split()
)


class Scalar(Place):
    """Where a number lies that is no array's."""

    __slots__ = ()

    def __str__(self) -> str:
        return self.array


class FilterPrograms(NamedTuple):
    """What the functions of a filter do, as programs whose places are expressions of C.

    Attributes:
        start: what the filter keeps besides mean and covariance, at the prior; of an ensemble the members.
        begin: X, which is predicted in place of them: points, one behind the other, or a mean and a root.
        advance: a substep of the belief or of X under u; of points that of one, x; of an ensemble all members.
        settle: the belief at the end of a step.
        update: the belief after z, the innovation, and what is told of it.
        summarise: mean and covariance of an ensemble.
        kept: the shapes of what the filter keeps, by name.
        flying: how many numbers X has.
        points: how many there are, if X are points that are moved one by one; else 0.
        members: how many an ensemble has; else 0.
        model: that the filter runs on.
        page: the module in which the filter's equations stand.
    """

    start: Program
    begin: Program
    advance: Program
    settle: Program
    update: Program
    summarise: Program
    kept: Mapping[str, tuple[int, ...]]
    flying: int
    points: int
    members: int
    model: StateSpaceModel
    page: str

    @property
    def all(self) -> tuple[Program, ...]:
        """The programs."""
        return self[:6]

    @property
    def operations(self) -> tuple[int, int]:
        """How many operations a prediction and an update are, without those of random numbers."""
        begin, advance, settle, update, summarise = (
            sum(self.members if one.member else 1 for one in program.works) for program in self[1:6]
        )
        substeps = self.model.substeps * max(self.points, 1)
        return begin + substeps * advance + settle + summarise, update


def programs_of(filter_: Filter) -> FilterPrograms:
    """The programs of a filter.

    Raises:
        ValueError: for a filter without a page, random rotations, a model whose functions cannot be traced or are
            too large, or a page that keeps something under a name that C does not take.
    """
    paged = with_page(filter_, "a filter in C")
    shape, (f, by_f, h, by_h) = paged.kernel_model.shape, paged.kernel_model.functions
    try:
        _check_traced("transition", f, by_f, 2, shape)
        _check_traced("observe", h, by_h, 1, shape)
        return _of_members(paged) if isinstance(paged, EnsembleFilter) else _of_rows(paged)
    except TooLarge as error:
        raise ValueError(f"a filter in C must have few operations, but got a model for which {error}") from error


def _of_rows(paged: FilterWithPage) -> FilterPrograms:
    """The programs of a filter of mean and covariance."""
    model, page, numbers = paged.kernel_model, paged.written_page, paged.numbers
    shape = model.shape
    places, memory = memory_places(shape.n, shape.m), RowMemory(shape, page)
    equations = Equations(model.functions, memory, constants_move=False, trace=True)
    stages = [one.of_rows for one in stages_of(page, memory, equations)]
    kept = {name: one.shape for name, one in memory.kept.items()}
    if wrong := [name for name in kept if name in TOLD or not is_name(name) or is_macro(name)]:
        raise ValueError(f"a quantity of a filter in C must have an unused name, but got {wrong[0]!r}")
    flying = memory.end - places.extras - sum(prod(size) for size in kept.values())
    points = _points_of(stages[2], equations, memory, flying)
    if points:
        stages[2] = {places.mean: equations.f(memory.x, memory.u)}
    stages[4][NIS] = _nis(stages[4][places.innovation], stages[4][places.innovation_cov])
    others = [
        *((one.operation.at, one.shape, f"filter->{name}") for name, one in memory.kept.items()),
        (memory.end - flying, (flying,), "X"),
    ]
    means = ["filter->x"] * 2 + ["x" if points else "filter->x"] + ["filter->x"] * 2
    start, begin, advance, settle, update = (
        _program({Place("rows", at): one for at, one in stage.items()}, lies, numbers, Graph(MOST))
        for stage, mean, given in zip(stages, means, "uuuuz", strict=True)
        for lies in [_where(shape, mean, given, others, points)]
    )
    programs = start, begin, advance, settle, update, Program([], [], [])
    return FilterPrograms(*programs, kept, flying, points, 0, model, page.update.__module__)


def _of_members(paged: EnsembleFilter) -> FilterPrograms:
    """The programs of an ensemble filter."""
    check_page_is_all(paged, "in C")
    model, page, numbers, size = paged.kernel_model, paged.written_page, paged.numbers, paged.size
    shape, memory = model.shape, MembersMemory(model.shape, page)
    stages = stages_of_members(page, memory, Equations(model.functions, memory, constants_move=False, trace=True))
    told = {place: one for name in stages for place, one in stages[name].stores[0]}
    places = memory_places(shape.n, shape.m)
    v, s = (told[Place("rows", at)] for at in (places.innovation, places.innovation_cov))
    stages["update"].values[Place("rows", NIS)] = _nis(v, s)
    kept = {name: one.shape for name, one in memory.kept.items()}
    others = [(one.operation.at, one.shape, f"filter->{name}") for name, one in memory.kept.items()]
    begin = Program([], [], [])
    start, advance, settle, update, summarise = (
        _program(dict(stages[name].stores[0]), lies, numbers, Graph(MOST, size))
        for name, given in (("start", "u"), ("advance", "u"), ("settle", "u"), ("update", "z"), ("summarise", "z"))
        for lies in [_where(shape, "filter->x", given, others)]
    )
    programs = start, begin, advance, settle, update, summarise
    return FilterPrograms(*programs, kept, 0, 0, size, model, type(paged).page.update.__module__)


def _nis(v: Matrix, s: Matrix) -> Matrix:
    return dot(v, quotient(v, factor(s)))


def _check_traced(name: str, function: Callable, jacobian: Callable | None, others: int, shape: Shape) -> None:
    """Raise ValueError that names a function which does not take numbers that are not known yet."""
    try:
        Traced(function, jacobian, others, shape)
    except TooLarge:
        raise
    except Exception as error:  # whatever a user's function raises
        raise ValueError(
            f"{name} must consist of arithmetic and functions of math or numpy, with a few branches at most, but "
            f"{getattr(function, '__name__', 'it')} raised {type(error).__name__}: {str(error).splitlines()[0]}"
        ) from error


def _points_of(advance: Mapping[int, Matrix], equations: Equations, memory: RowMemory, flying: int) -> int:
    """How many points a substep moves, each by f alone; 0 where it does something else."""
    (at, moved), *others = advance.items()
    if flying == 0 or others or not moved.of or moved.of[0].operation != Place("rows", at):
        return 0
    return moved.shape[1] if moved is equations.f(moved.of[0], memory.u) else 0


def _where(
    shape: Shape, mean: str, given: str, others: Sequence[tuple[int, tuple[int, ...], str]], points: int = 0
) -> Callable[[Place], Place]:
    """Where a place lies in C: in the filter, in X, or in what is given, u or z."""
    n, m = shape.n, shape.m
    places = memory_places(n, m)
    parts = [
        (NIS, (), "filter->nis"),
        (places.mean, (n,), mean),
        (places.cov, (n, n), "filter->P"),
        (places.innovation, (m,), "filter->innovation"),
        (places.innovation_cov, (m, m), "filter->S"),
        (places.log_likelihood, (), "filter->log_likelihood"),
        *others,
    ]

    def lies(place: Place) -> Place:
        if place.array == "given":
            return Place(given, place.at)
        if place.array in BY_MEMBERS:
            return place
        first, size, name = next(one for one in parts if 0 <= place.at - one[0] < prod(one[1]))
        at = place.at - first
        if name == "X" and points:  # one behind the other
            row, column = divmod(at, points)
            at = column * n + row
        return Place(name, at) if size else Scalar(name, at)

    return lies


def _program(
    stage: Mapping[Place, Matrix], lies: Callable[[Place], Place], numbers: np.ndarray, graph: Graph
) -> Program:
    """The program of a stage, of the numbers of a model and a filter as constants."""

    def number(place: Place, **of_member: bool):
        if place.array == "numbers":
            return graph.constant(numbers[place.at])
        return graph.given(lies(place), **of_member)

    wanted, stores = list(stage.values()), []
    for (array, first), value in zip(stage, evaluate(wanted, numbers_of(wanted, number)), strict=True):
        for k, one in enumerate(np.ravel(np.array(value, dtype=object))):
            stores.append((lies(Place(array, first + k)), graph.number(one)))
    return program_of(stores, {})
