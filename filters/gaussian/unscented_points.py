"""Sigma points of the scaled unscented transform, how they move, and moments of values at them."""

from __future__ import annotations

from filters.algebra.operations import wrap
from filters.algebra.points import first, ones, others, outer, square, units


def points(model, x, L):
    """The mean, and the points around it."""
    return outer(x, ones(units(x))) + (L * model.own.spread) @ units(x)


def moments(model, Y, angles):
    """Mean and shift of values at the points, and their deviations."""
    D = wrap(others(Y) - outer(first(Y), ones(others(Y))), angles)
    s = (D @ ones(D)) * model.own.weight
    return first(Y) + s, s, D


def scatter(model, D, s):
    """The covariance of such deviations."""
    return square(D) * model.own.weight + outer(s, s) * model.own.shift_weight


def advance(model, X, u):
    """One of the model's substeps, of each point."""
    return model.f(X, u)
