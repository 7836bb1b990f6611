"""Which filters have a smoother of Rauch, Tung and Striebel, and how their successive states are related."""

from __future__ import annotations

from filters.filter import Filter
from filters.gaussian.cubature import CubatureKalmanFilter
from filters.gaussian.extended import ExtendedKalmanFilter
from filters.gaussian.iterated import IteratedExtendedKalmanFilter
from filters.gaussian.kalman import KalmanFilter
from filters.gaussian.unscented import UnscentedKalmanFilter
from filters.smoothers.points import CUBATURE, UNSCENTED
from filters.smoothers.rts import LINEARISED, SCHEDULED, Relation

RELATIONS: dict[type[Filter], Relation] = {
    KalmanFilter: LINEARISED,
    ExtendedKalmanFilter: LINEARISED,
    IteratedExtendedKalmanFilter: LINEARISED,
    UnscentedKalmanFilter: UNSCENTED,
    CubatureKalmanFilter: CUBATURE,
}


def relation_of(filter_: Filter, what: str, others: str = "") -> Relation:
    """What `smooth_backwards` needs to know of a filter; ValueError if it has no such smoother."""
    kind = type(filter_)
    if filter_.model.bounds:
        raise ValueError(f"{what} needs a model without bounds, but got {filter_.model.bounds}")
    if isinstance(filter_, KalmanFilter) and kind is KalmanFilter and filter_.schedule > 1:
        return SCHEDULED
    if kind in RELATIONS:
        return RELATIONS[kind]
    known = ", ".join(known.name for known in RELATIONS)
    raise ValueError(f"{what} needs a filter of {known}{others}, but got {filter_.name!r}")
