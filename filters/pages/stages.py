"""A stage of a filter with derivatives: two functions, of which one works out values, the other slopes of these.

The first is called once, the second for each parameter. What slopes need of the values is worked out with them
and kept in memory: in the graph of the slopes it is what does not depend on a parameter, and is an argument of
what does.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from math import prod
from typing import Any, NamedTuple

import numpy as np

from filters.algebra.calls import arguments_of, calls_of
from filters.algebra.derivatives import slopes_of
from filters.algebra.matrices import Matrix, Operation, evaluate, in_order
from filters.algebra.operations import present
from thruster_env.graphs.graphs import CONDITIONS, Graph, Number, needed_by
from thruster_env.graphs.programs import ARRAYS, Place, program_of

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
