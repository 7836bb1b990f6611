"""The filters that have derivatives: those with a page, but for a schedule of gains and the steady one."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

from filters.adaptive.robust import RobustExtendedKalmanFilter
from filters.adaptive.sage_husa import SageHusaFilter
from filters.adaptive.variational import VariationalBayesFilter
from filters.filter import Filter
from filters.gaussian.cubature import CubatureKalmanFilter
from filters.gaussian.extended import ExtendedKalmanFilter
from filters.gaussian.fading import FadingMemoryFilter
from filters.gaussian.h_infinity import HInfinityFilter
from filters.gaussian.iterated import IteratedExtendedKalmanFilter
from filters.gaussian.kalman import KalmanFilter
from filters.gaussian.schmidt import SchmidtKalmanFilter
from filters.gaussian.unscented import UnscentedKalmanFilter
from filters.pages.page_filter import Page, PageFilter
from thruster_env.model.state_space import StateSpaceModel

KINDS: tuple[type[PageFilter], ...] = (
    KalmanFilter,
    ExtendedKalmanFilter,
    IteratedExtendedKalmanFilter,
    UnscentedKalmanFilter,
    CubatureKalmanFilter,
    FadingMemoryFilter,
    HInfinityFilter,
    SchmidtKalmanFilter,
    RobustExtendedKalmanFilter,
    SageHusaFilter,
    VariationalBayesFilter,
)


def has_derivatives(kind: type[Filter]) -> bool:
    """Whether a class of filters has derivatives: one of `KINDS`, or a user's that has a page."""
    return kind in KINDS or (not kind.__module__.startswith("filters.") and issubclass(kind, PageFilter))


class Differentiable(NamedTuple):
    """What derivatives are taken of."""

    model: StateSpaceModel  # that the filter runs on
    page: Page
    own: tuple[float, ...]  # the filter's parameters


def differentiable(model: StateSpaceModel, filter_: Filter | None) -> Differentiable:
    """A filter with another model in place of its own; of None the extended Kalman filter.

    Raises:
        ValueError: for a filter without a page, or a value of its own that does not go with the model.
    """
    if filter_ is None:
        return Differentiable(model, ExtendedKalmanFilter.page, ())
    if not isinstance(filter_, Filter):
        raise ValueError(f"filter must be an object that make_filter returns, but got {filter_!r}")
    if not (isinstance(filter_, PageFilter) and has_derivatives(type(filter_))):
        names = ", ".join(kind.name for kind in KINDS)
        raise ValueError(f"a filter with derivatives must be one of {names}, but got {filter_.name!r}")
    if isinstance(filter_, KalmanFilter) and filter_.schedule != 1:
        raise ValueError(f"a filter with derivatives must have schedule=1, but got {filter_.schedule}")
    form = {"form": "covariance"} if filter_.forms else {}  # of the same estimates
    used = replace(filter_, model=model, **form)
    return Differentiable(used.kernel_model, used.written_page, used.own_parameters)
