"""The square-root form of the unscented filter: P, S and the gain follow from one triangle (`square_root`)."""

from __future__ import annotations

from filters.algebra.blocks import hstack, part, triangle, vstack, zeros
from filters.algebra.operations import only, present, uncorrelated, wrap
from filters.algebra.points import ones, others, outer, root, square, units
from filters.gaussian.square_root import start, updated
from filters.gaussian.unscented_points import advance, moments, points
from filters.pages.page import Page


def begin(model, x, P):
    """The points of a belief, by the root that is kept."""
    return points(model, x, model.kept["L"])


def deviations(model, D, s):
    """A matrix A with A A' = scatter(D, s)."""
    return hstack(D * model.own.weight_root, outer(s * model.own.shift_root, ones(part(D, 0, 0, len(s), 1))))


def settle(model, X):
    """The end of a step."""
    x, s, D = moments(model, X, model.state_angles)
    L = triangle(hstack(deviations(model, D, s), model.Q_root))
    return wrap(x, model.state_angles), square(L), {"L": L}


def update(model, x, P, z):
    """The measurement z; channels that are NaN are missing."""
    n, m, seen, L = len(x), len(z), present(z), model.kept["L"]
    y, s, D = moments(model, model.h(points(model, x, L)), model.measurement_angles)
    s, D, R = only(seen, s), only(seen, D), uncorrelated(seen, model.R)
    v = only(seen, wrap(z - y, model.measurement_angles))
    of_x = (L * model.own.spread) @ others(units(x)) * model.own.weight_root
    both = vstack(hstack(deviations(model, D, s), root(R)), hstack(of_x, zeros(L, n, m + 1)))
    return updated(model, x, triangle(both), v, seen)


ROOT = Page(advance, settle, update, begin, start)
