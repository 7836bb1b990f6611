"""A Kalman filter whose affine model follows the input: gain scheduling.

The constants c of the model in use are linear in the input between the points of the schedule, and constant
beyond them; they are those of the last input until the next, and at first those of u = 0.
"""

from __future__ import annotations

from filters.algebra.blocks import zeros
from filters.algebra.points import hats
from filters.gaussian import extended
from filters.pages.page import Page


def constants_at(model, u):
    """Constants of the affine model at an input."""
    return model.own.models.T @ hats(u, model.own.inputs)


def start(model):
    """The model at u = 0."""
    return {"c": constants_at(model, zeros(model.own.models, 1))}


def advance(model, x, P, u):
    """One of the model's substeps."""
    c = constants_at(model, u)
    return *extended.advance(model.at(c), x, P, u), {"c": c}


def update(model, x, P, z):
    """The measurement z; channels that are NaN are missing."""
    return extended.update(model.at(model.kept["c"]), x, P, z)


SCHEDULED = Page(advance, extended.settle, update, start=start)
