"""Stages of a page as programs, or, of models that cannot be traced, as calls."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from filters.algebra.matrices import Matrix
from filters.pages.equations import Equations
from filters.pages.memory import RowMemory
from filters.pages.page import Page
from filters.pages.stages import Stage, as_calls, as_programs
from filters.pages.traced import MOST
from thruster_env.graphs.graphs import uncollected
from thruster_env.graphs.programs import BY_MEMBERS, OF_STEPS, Place, callable_of
from thruster_env.model.layout import LANES, constants_reader
from thruster_env.model.shape import Functions, Shape


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
