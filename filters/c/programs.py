"""A page's stages as programs in C: a model's numbers are constants in them, so that zeros and ones vanish."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from math import prod
from typing import NamedTuple

import numpy as np

from filters.engine.layout import memory_places
from filters.filter import Filter
from filters.pages.equations import Equations
from filters.pages.kernels import stages_of
from filters.pages.memory import RowMemory
from filters.pages.page_filter import with_page
from filters.pages.stages import numbers_of
from filters.pages.traced import MOST, Traced
from thruster_env.numerics.algebra.densities import dot
from thruster_env.numerics.algebra.graphs import Graph, TooLarge
from thruster_env.numerics.algebra.matrices import Matrix, evaluate
from thruster_env.numerics.algebra.operations import factor, quotient
from thruster_env.numerics.algebra.programs import Place, Program, program_of
from thruster_env.plants.shape import Shape
from thruster_env.plants.state_space import StateSpaceModel

NIS = -1  # its place in a row, where machine code has none
TOLD = ("x", "P", "innovation", "S", "nis", "log_likelihood", "channels", "restarts")  # of each filter in C
KEYWORDS = frozenset(
    "auto break case char const continue default do double else enum extern float for goto if inline int long "
    "main register restrict return short signed sizeof static struct switch typedef union unsigned void volatile "
    "while".split()
)


class Scalar(Place):
    """Where a number lies that is no array's."""

    __slots__ = ()

    def __str__(self) -> str:
        return self.array


class FilterPrograms(NamedTuple):
    """What the functions of a filter do, as programs whose places are expressions of C.

    Attributes:
        start: what the filter keeps besides mean and covariance, at the prior.
        begin: X, which is predicted in place of them: points, one behind the other, or a mean and a root.
        advance: a substep of the belief or of X under u; of points that of one, x.
        settle: the belief at the end of a step.
        update: the belief after z, the innovation, and what is told of it.
        kept: the shapes of what the filter keeps, by name.
        flying: how many numbers X has.
        points: how many there are, if X are points that are moved one by one; else 0.
        model: that the filter runs on.
        page: the module in which the filter's equations stand.
    """

    start: Program
    begin: Program
    advance: Program
    settle: Program
    update: Program
    kept: Mapping[str, tuple[int, ...]]
    flying: int
    points: int
    model: StateSpaceModel
    page: str


def programs_of(filter_: Filter) -> FilterPrograms:
    """The programs of a filter.

    Raises:
        ValueError: for a filter without a page, a model whose functions cannot be traced or are too large, or a
            page that keeps something under a name that C does not take.
    """
    paged = with_page(filter_, "a filter in C")
    model, page, numbers = paged.kernel_model, paged.written_page, paged.numbers
    shape, (f, by_f, h, by_h) = model.shape, model.functions
    places, memory = memory_places(shape.n, shape.m), RowMemory(shape, page)
    try:
        _check_traced("transition", f, by_f, 2, shape)
        _check_traced("observe", h, by_h, 1, shape)
        equations = Equations(model.functions, memory, constants_move=False, trace=True)
        stages = [one.of_rows for one in stages_of(page, memory, equations)]
        kept = {name: one.shape for name, one in memory.kept.items()}
        if wrong := [name for name in kept if name in TOLD or not is_name(name)]:
            raise ValueError(f"what a filter in C keeps must have a name that is free there, but got {wrong[0]!r}")
        flying = memory.end - places.extras - sum(prod(size) for size in kept.values())
        points = _points_of(stages[2], equations, memory, flying)
        if points:
            stages[2] = {places.mean: equations.f(memory.x, memory.u)}
        v, s = stages[4][places.innovation], stages[4][places.innovation_cov]
        stages[4][NIS] = dot(v, quotient(v, factor(s)))
        means = ["filter->x"] * 2 + ["x" if points else "filter->x"] + ["filter->x"] * 2
        written = [
            _program(stage, _where(memory, flying, points, mean, given), numbers)
            for stage, mean, given in zip(stages, means, "uuuuz", strict=True)
        ]
    except TooLarge as error:
        raise ValueError(f"a filter in C must have few operations, but got a model for which {error}") from error
    start, begin, advance, settle, update = written
    return FilterPrograms(
        start, begin, advance, settle, update, kept, flying, points, model, page.update.__module__
    )


def is_name(text: str) -> bool:
    """Whether C takes a name."""
    return bool(re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", text, flags=re.ASCII)) and text not in KEYWORDS


def _check_traced(name: str, function: Callable, jacobian: Callable | None, others: int, shape: Shape) -> None:
    """Raise ValueError that names a function which does not take numbers that are not known yet."""
    try:
        Traced(function, jacobian, others, shape)
    except TooLarge:
        raise
    except Exception as error:  # whatever a user's function raises
        raise ValueError(
            f"{name} must consist of arithmetic and functions of math or numpy, and decide nothing, but "
            f"{getattr(function, '__name__', 'it')} raised {type(error).__name__}: {str(error).splitlines()[0]}"
        ) from error


def _points_of(advance: Mapping[int, Matrix], equations: Equations, memory: RowMemory, flying: int) -> int:
    """How many points a substep moves, each by f alone; 0 where it does something else."""
    (at, moved), *others = advance.items()
    if flying == 0 or others or not moved.of or moved.of[0].operation != Place("rows", at):
        return 0
    return moved.shape[1] if moved is equations.f(moved.of[0], memory.u) else 0


def _where(memory: RowMemory, flying: int, points: int, mean: str, given: str) -> Callable[[Place], Place]:
    """Where a place lies in C: in the filter, in X, or in what is given, u or z."""
    n, m = memory.shape.n, memory.shape.m
    places = memory_places(n, m)
    parts = [
        (NIS, (), "filter->nis"),
        (places.mean, (n,), mean),
        (places.cov, (n, n), "filter->P"),
        (places.innovation, (m,), "filter->innovation"),
        (places.innovation_cov, (m, m), "filter->S"),
        (places.log_likelihood, (), "filter->log_likelihood"),
        *((one.operation.at, one.shape, f"filter->{name}") for name, one in memory.kept.items()),
        (memory.end - flying, (flying,), "X"),
    ]

    def lies(place: Place) -> Place:
        if place.array == "given":
            return Place(given, place.at)
        first, shape, name = next(one for one in parts if 0 <= place.at - one[0] < prod(one[1]))
        at = place.at - first
        if name == "X" and points:  # one behind the other
            row, column = divmod(at, points)
            at = column * n + row
        return Place(name, at) if shape else Scalar(name, at)

    return lies


def _program(stage: Mapping[int, Matrix], lies: Callable[[Place], Place], numbers: np.ndarray) -> Program:
    """The program of a stage, of the numbers of a model and a filter as constants."""
    graph = Graph(MOST)

    def number(place: Place):
        if place.array == "numbers":
            return graph.constant(numbers[place.at])
        return graph.given(lies(place))

    wanted, stores = list(stage.values()), []
    for at, value in zip(stage, evaluate(wanted, numbers_of(wanted, number)), strict=True):
        for k, one in enumerate(np.ravel(np.array(value, dtype=object))):
            stores.append((lies(Place("rows", at + k)), graph.number(one)))
    return program_of(stores, {})
