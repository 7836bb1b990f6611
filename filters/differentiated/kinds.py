"""The filters that have a page, and so derivatives."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from typing import NamedTuple

from filters.filter import Filter
from filters.gaussian.cubature import CubatureKalmanFilter
from filters.gaussian.extended import ExtendedKalmanFilter
from filters.gaussian.iterated import IteratedExtendedKalmanFilter
from filters.gaussian.kalman import KalmanFilter
from filters.gaussian.unscented import UnscentedKalmanFilter
from filters.pages import cubature, extended, iterated, unscented
from plants.state_space import StateSpaceModel


class Kind(NamedTuple):
    """A page: what a step does with the belief, or between `begin` and `settle` with points X (n, points).

    x, P = settle(model, *advance(model, x, P, u)),  or
    x, P = settle(model, advance(model, begin(model, x, P), u)),  and
    x, P, v, S, log N(v; 0, S) = update(model, x, P, z)
    """

    advance: Callable  # in each of the model's substeps
    settle: Callable
    update: Callable
    begin: Callable | None = None
    points_beside: int = 0  # points without the 2n that lie around the mean
    own: int = 0  # how many numbers of its own the page takes, as `model.own`

    def points(self, n: int) -> int:
        """How many points there are, of n states."""
        return 0 if self.begin is None else 2 * n + self.points_beside


EXTENDED = Kind(extended.advance, extended.settle, extended.update)
UNSCENTED = Kind(unscented.advance, unscented.settle, unscented.update, unscented.begin, 1, 3)
CUBATURE = Kind(cubature.advance, cubature.settle, cubature.update, cubature.begin, 0, 3)


@cache
def _iterated(iterations: int) -> Kind:
    """The page with so many iterations, which are written out."""
    return Kind(iterated.advance, iterated.settle, partial(iterated.update, iterations=iterations))


KINDS: dict[type[Filter], Callable[..., Kind]] = {
    KalmanFilter: lambda filter_: EXTENDED,
    ExtendedKalmanFilter: lambda filter_: EXTENDED,
    IteratedExtendedKalmanFilter: lambda filter_: _iterated(filter_.iterations),
    UnscentedKalmanFilter: lambda filter_: UNSCENTED,
    CubatureKalmanFilter: lambda filter_: CUBATURE,
}


class Differentiable(NamedTuple):
    """What derivatives are taken of."""

    model: StateSpaceModel  # that the filter runs on
    kind: Kind
    own: tuple[float, ...]  # the filter's own numbers that its page takes


def differentiable(model: StateSpaceModel, filter_: Filter | None) -> Differentiable:
    """A filter with another model in place of its own; of None the extended Kalman filter.

    Raises:
        ValueError: for a filter without a page, or a value of its own that does not go with the model.
    """
    if filter_ is None:
        return Differentiable(model, EXTENDED, ())
    if not isinstance(filter_, Filter):
        raise ValueError(f"filter must be an object that make_filter returns, but got {filter_!r}")
    if type(filter_) not in KINDS:
        names = ", ".join(kind.name for kind in KINDS)
        raise ValueError(f"a filter with derivatives must be one of {names}, but got {filter_.name!r}")
    if isinstance(filter_, KalmanFilter) and filter_.schedule != 1:
        raise ValueError(f"a filter with derivatives must have schedule=1, but got {filter_.schedule}")
    used = replace(filter_, model=model)
    kind = KINDS[type(filter_)](used)
    return Differentiable(used.kernel_model, kind, tuple(used.own_numbers)[: kind.own])
