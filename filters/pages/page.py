"""A filter that is written as in a textbook: pure functions of small matrices, and a class with its parameters.

The functions take a model, whose f(x, u), F(x, u), h(x), H(x), Q and R are those of the equations, and matrices.
Without points or other forms of the belief a step is

    x, P = settle(model, *advance(model, x, P, u)),  advance once for each of the model's substeps
    x, P, v, S, log N(v; 0, S) = update(model, x, P, z)

Filters that predict another form of the belief, such as sigma points X, have a `begin` that makes it:

    x, P = settle(model, advance(model, begin(model, x, P), u))

What a filter keeps besides x and P, such as an estimate of R, it names: `start(model)` returns it as a dictionary,
the functions find it in `model.kept`, and return what changes in a dictionary behind their other results.
"""

from __future__ import annotations

import dataclasses
from collections import namedtuple
from collections.abc import Callable, Iterator, Mapping
from functools import cache, cached_property
from math import prod
from typing import Any, ClassVar, NamedTuple

import numpy as np

from filters.engine.belief import Kernels
from filters.filter import Filter


class Page(NamedTuple):
    """The functions of a filter, and what stands in `model.own`."""

    advance: Callable  # in each of the model's substeps
    settle: Callable  # at the end of a step
    update: Callable
    begin: Callable | None = None
    start: Callable | None = None
    own: tuple[tuple[str, tuple[int, ...]], ...] = ()  # parameters and their shapes
    fixed: tuple[tuple[str, Any], ...] = ()  # values that stand in programs, such as how often a loop runs

    def parameters(self, read: Callable[[int, tuple[int, ...]], Any]) -> Any:
        """What pages find in `model.own`: `read(place, shape)` of each parameter, and fixed values."""
        values, place = [], 0
        for _, shape in self.own:
            values.append(read(place, shape))
            place += prod(shape)
        names = tuple(name for name, _ in (*self.own, *self.fixed))
        return _own_class(names)(*values, *(value for _, value in self.fixed))

    @property
    def own_size(self) -> int:
        """How many numbers the parameters are."""
        return sum(prod(shape) for _, shape in self.own)


@cache
def _own_class(names: tuple[str, ...]) -> type:
    return namedtuple("Own", names)


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class PageFilter(Filter):
    """Base of filters that have a page; subclasses name it, and add their parameters as fields.

    Attributes:
        page: its functions.
        unrolled: fields that are whole numbers and say how often something is repeated; each value has a program
            of its own. Other fields are numbers that programs read.
        ranges: of fields that studies may tune, the smallest and the largest value.
    """

    page: ClassVar[Page]
    unrolled: ClassVar[tuple[str, ...]] = ()
    ranges: ClassVar[Mapping[str, tuple[float, float]]] = {}

    @property
    def parameters(self) -> Mapping[str, Any]:
        """Numbers and arrays that the page finds in `model.own`: fields, unless a filter says otherwise."""
        return {name: getattr(self, name) for name in self._fields() if name not in self.unrolled}

    def _fields(self) -> Iterator[str]:
        return (field.name for field in dataclasses.fields(self) if field.name != "model")

    @cached_property
    def own_numbers(self) -> tuple[float, ...]:
        """The parameters, one behind the other."""
        return tuple(float(number) for value in self.parameters.values() for number in np.ravel(value))

    @property
    def written_page(self) -> Page:
        """The page, with the shapes of the parameters."""
        own = tuple((name, np.shape(value)) for name, value in self.parameters.items())
        return self.page._replace(own=own, fixed=tuple((name, getattr(self, name)) for name in self.unrolled))

    def kernels(self) -> Kernels:
        """Kernels of the page for the model's functions; see `Filter.kernels`."""
        from filters.pages.kernels import page_kernels

        return page_kernels(self.written_page, self.kernel_model.functions, self.kernel_model.shape)
