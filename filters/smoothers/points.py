"""Sigma-point smoothers, and which smoother belongs to which filter.

    points X = x 1' + g L U,  L L' = P;  predicted x and P as the filter predicts,
    G = cov(x, f(X)) (predicted P)^-1,  bracket = cov(X - G f(X)) + G Q G'

The bracket equals P - G (predicted P) G' and is a sum of squares.

Source: Sarkka (2008), "Unscented Rauch-Tung-Striebel smoother", algorithm 1, with additive noise; for cubature
points Arasaratnam, Haykin (2011), "Cubature Kalman smoothers".
"""

from __future__ import annotations

from filters.algebra.blocks import careful
from filters.algebra.operations import quotient, sym
from filters.algebra.points import root, square, units, without_first
from filters.filter import Filter
from filters.gaussian import sigma_points
from filters.gaussian.extended import ExtendedKalmanFilter, IteratedExtendedKalmanFilter
from filters.gaussian.kalman import KalmanFilter
from filters.gaussian.sigma_points import CubatureKalmanFilter, UnscentedKalmanFilter, propagate_points, scatter
from filters.smoothers.rts import LINEARISED, SCHEDULED, Relation


def link_unscented(model, x, P, X):
    """The link of an unscented filter."""
    g, w, L, U = model.own.spread, model.own.weight, root(P), without_first(units(x))
    mean, s, D = sigma_points.unscented_moments(model, X, model.state_angles)
    C = (L @ (U @ D.T)) * (w * g)
    G = quotient(C, careful(scatter(model, D, s) + model.Q))
    left = scatter(model, (L * g) @ U - G @ D, G @ s)
    return mean, G, left + sym(G @ model.Q @ G.T)


def link_cubature(model, x, P, X):
    """The link of a cubature filter."""
    (g, w), L, U = model.own, root(P), without_first(units(x))
    mean, D = sigma_points.cubature_moments(model, X, model.state_angles)
    C = (L @ (U @ D.T)) * (w * g)
    G = quotient(C, careful(square(D) * w + model.Q))
    return mean, G, square((L * g) @ U - G @ D) * w + sym(G @ model.Q @ G.T)


UNSCENTED = Relation(sigma_points.represent_unscented, propagate_points, link_unscented)
CUBATURE = Relation(sigma_points.represent_cubature, propagate_points, link_cubature)


# Filters that have a smoother of Rauch, Tung and Striebel.
RELATIONS: dict[type[Filter], Relation] = {
    KalmanFilter: LINEARISED,
    ExtendedKalmanFilter: LINEARISED,
    IteratedExtendedKalmanFilter: LINEARISED,
    UnscentedKalmanFilter: UNSCENTED,
    CubatureKalmanFilter: CUBATURE,
}


def relation_of(filter_: Filter, what: str, alternatives: str = "") -> Relation:
    """The relation of a filter for `smooth_backwards`; ValueError if it has no such smoother."""
    kind = type(filter_)
    if filter_.model.bounds:
        raise ValueError(f"{what} needs a model without bounds, but got {filter_.model.bounds}")
    if isinstance(filter_, KalmanFilter) and kind is KalmanFilter and filter_.schedule > 1:
        return SCHEDULED
    if kind in RELATIONS:
        return RELATIONS[kind]
    known = ", ".join(known.name for known in RELATIONS)
    raise ValueError(f"{what} needs a filter of {known}{alternatives}, but got {filter_.name!r}")
