"""A page's functions as programs: the numbers of a model are constants in them, so that zeros and ones vanish."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from filters.differentiated.differentiable import differentiable
from filters.filter import Filter
from filters.pages.page import Page
from filters.pages.paged import Paged
from filters.pages.traced import MOST, Traced
from numerics.algebra.densities import dot
from numerics.algebra.graphs import Graph, TooLarge
from numerics.algebra.matrices import Matrix, evaluate, transposed
from numerics.algebra.operations import factor, quotient
from numerics.algebra.programs import Place, Program, program_of
from plants.shape import Shape
from plants.state_space import StateSpaceModel

BELIEF = "filter->x", "filter->P"  # where results lie in C
TOLD = "filter->innovation", "filter->S", "filter->log_likelihood", "filter->nis"
POINTS, POINT = "X", "x"


class Scalar(Place):
    """Where a number lies that is no array's."""

    __slots__ = ()

    def __str__(self) -> str:
        return self.array


class FilterPrograms(NamedTuple):
    """What the functions of a filter do, as programs whose places are expressions of C.

    Attributes:
        begin: the points X from the belief, one behind the other, of filters that have some; else None.
        advance: a substep of the belief, or of one point x, under u.
        settle: the belief at the end of a step.
        update: the belief after z, and what `TOLD` names.
        model: that the filter runs on.
        points: how many there are.
        page: the module in which the filter's equations stand.
    """

    begin: Program | None
    advance: Program
    settle: Program
    update: Program
    model: StateSpaceModel
    points: int
    page: str


class _Traced:
    """An equation of a model, of Numbers."""

    def __init__(self, name: str, function: Callable, jacobian: Callable | None, others: int, shape: Shape):
        try:
            equation = Traced(function, jacobian, others, shape)
        except TooLarge:
            raise
        except Exception as error:  # whatever a user's function raises of numbers that are not known yet
            raise ValueError(
                f"{name} must consist of arithmetic and functions of math or numpy, and decide nothing, but "
                f"{getattr(function, '__name__', 'it')} raised {type(error).__name__}: "
                f"{str(error).splitlines()[0]}"
            ) from error
        value, matrix, *_ = equation.parts
        self.with_jacobian = lambda x, *given: (value(x, *given), matrix(x, None, *given))
        self.of_points = equation.of_points[0]


def programs_of(filter_: Filter) -> FilterPrograms:
    """The programs of a filter.

    Raises:
        ValueError: for a filter without a page, or a model whose functions cannot be traced or are too large.
    """
    model, page, own = differentiable(filter_.model, filter_)
    shape, (f, by_f, h, by_h) = model.shape, model.functions
    try:
        motion, sight = _Traced("transition", f, by_f, 2, shape), _Traced("observe", h, by_h, 1, shape)
        return _programs(Paged(motion, sight, shape, page), page, model, own)
    except TooLarge as error:
        raise ValueError(f"a filter in C must have few operations, but got a model for which {error}") from error


def _programs(paged: Paged, page: Page, model: StateSpaceModel, own: Sequence[float]) -> FilterPrograms:
    given, (mean, cov, v, s, level) = paged.given, paged.update
    constants = dict(zip(given.own, own, strict=False)) | {given.Q: model.process_noise_cov}
    constants |= {given.R: model.measurement_noise_cov, given.constants: model.constants}
    belief = {given.x: BELIEF[0], given.P: BELIEF[1], given.u: "u", given.z: "z", given.X.T: POINTS}
    if not paged.begin:
        begin, advance = None, _program(dict(zip(BELIEF, paged.advance, strict=True)), belief, constants)
    else:
        if paged.advance != (given.f(given.X, given.u),):
            raise ValueError("a page with points must do nothing to them but move each by f, but one does")
        begin = _program({POINTS: paged.begin[0].T}, belief, constants)
        advance = _program({POINT: given.f(given.x, given.u)}, belief | {given.x: POINT}, constants)
    told = dict(zip(TOLD, (v, s, level, dot(v, quotient(v, factor(s)))), strict=True))
    return FilterPrograms(
        begin,
        advance,
        settle=_program(dict(zip(BELIEF, paged.settle, strict=True)), belief, constants),
        update=_program(dict(zip(BELIEF, (mean, cov), strict=True)) | told, belief, constants),
        model=model,
        points=given.X.shape[1],
        page=page.update.__module__,
    )


def _program(results: Mapping[str, Matrix], arrays: Mapping[Matrix, str], constants: Mapping) -> Program:
    """The program that stores some results, of matrices that lie in arrays, and of constants."""
    graph = Graph(MOST)
    known = {
        one: _entries(one, lambda k, array=array: graph.given(Place(array, k))) for one, array in arrays.items()
    }
    known |= {one.arguments[0]: entries.T for one, entries in known.items() if one.operation is transposed}
    for one, value in constants.items():
        numbers = np.ravel(value)
        known[one] = _entries(one, lambda k, numbers=numbers: graph.constant(numbers[k]))
    stores = []
    for array, value in zip(results, evaluate(list(results.values()), known), strict=True):
        entries = np.array(value, dtype=object)
        kind = Place if entries.shape else Scalar
        stores += [(kind(array, k), graph.number(one)) for k, one in enumerate(entries.ravel())]
    return program_of(stores, {})


def _entries(one: Matrix, number: Callable):
    """The entries of a matrix, number(k) by rows; of a symmetric one only those on and below the diagonal."""
    found = np.empty(one.shape, dtype=object)
    for at in np.ndindex(*one.shape):
        there = tuple(sorted(at, reverse=True)) if one.symmetric else at
        found[at] = number(int(np.ravel_multi_index(there, one.shape)) if at else 0)
    return found if one.shape else found[()]
