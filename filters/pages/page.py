"""What a filter is that is written as in a textbook: pure functions of small matrices.

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

from collections import namedtuple
from collections.abc import Callable
from functools import cache
from math import prod
from typing import Any, NamedTuple


class Page(NamedTuple):
    """The functions of a filter, and what stands in `model.own`."""

    advance: Callable  # in each of the model's substeps
    settle: Callable  # at the end of a step
    update: Callable
    begin: Callable | None = None
    start: Callable | None = None
    own: tuple[tuple[str, tuple[int, ...]], ...] = ()  # parameters and their shapes
    fixed: tuple[tuple[str, Any], ...] = ()  # values that stand in programs, such as how often a loop runs
    renew: Callable | None = None  # of particles that were resampled
    foresee: Callable | None = None  # of particles that are resampled in the update, before that
    of_each: tuple[str, ...] = ()  # what is kept of each particle

    def started(self, model: Any) -> dict[str, Any]:
        """What a filter keeps, at the prior."""
        return {} if self.start is None else self.start(model)

    def parameters(self, read: Callable[[int, tuple[int, ...]], Any]) -> Any:
        """What pages find in `model.own`: `read(place, shape)` of each parameter, and fixed values."""
        values, place = [], 0
        for _, shape in self.own:
            values.append(read(place, shape))
            place += prod(shape)
        names = tuple(name for name, _ in (*self.own, *self.fixed))
        return _own_class(names)(*values, *(value for _, value in self.fixed))

    def places(self, first: int) -> dict[str, int]:
        """Where each parameter begins, if they lie one behind the other from `first` on."""
        found = {}
        for name, shape in self.own:
            found[name], first = first, first + prod(shape)
        return found

    @property
    def own_size(self) -> int:
        """How many numbers the parameters are."""
        return sum(prod(shape) for _, shape in self.own)


@cache
def _own_class(names: tuple[str, ...]) -> type:
    return namedtuple("Own", names)
