"""The Rauch-Tung-Striebel smoother: a Gaussian filter's estimates, corrected backwards in time.

    G_k = cov(x_k, x_{k+1}) cov(x_{k+1})^-1, both given the measurements up to k
    x_k += G_k (smoothed x_{k+1} - predicted x_{k+1})
    P_k = (P_k - G_k predicted P_{k+1} G_k') + G_k smoothed P_{k+1} G_k'

The bracket is computed as a covariance, so that P_k is one. How two successive states are related is the filter's:
its page of a smoother, a `Relation`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from filters.algebra.blocks import careful
from filters.algebra.operations import eye, quotient, sym, wrap
from filters.gaussian.schedule import constants_at


class Relation(NamedTuple):
    """A page of a smoother: from x and P at a step to the next one, and the link between the two."""

    begin: Callable  # begin(model, x, P): what is predicted
    advance: Callable  # advance(model, *predicted, u), in each of the model's substeps
    link: Callable  # link(model, x, P, *predicted): predicted x, G and the bracket


# The page of filters that linearise


def begin(model, x, P):
    """The mean, and the Jacobian of no substep."""
    return x, eye(P)


def advance(model, x, F, u):
    """One of the model's substeps."""
    return model.f(x, u), model.F(x, u) @ F


def link(model, x, P, mean, F):
    """G = P F' (F P F' + Q)^-1, and the bracket (I - G F) P (I - G F)' + G Q G'."""
    C = P @ F.T
    G = quotient(C, careful(sym(F @ C + model.Q)))
    A = eye(P) - G @ F
    return mean, G, sym(A @ P @ A.T) + sym(G @ model.Q @ G.T)


def advance_scheduled(model, x, F, u):
    """One of the substeps of the affine model at an input."""
    return advance(model.at(constants_at(model, u)), x, F, u)


LINEARISED = Relation(begin, advance, link)
SCHEDULED = Relation(begin, advance_scheduled, link)


def back(model, x, P, linked, later):
    """The estimate of a step, corrected by that of the next one."""
    (mean, G, C), (later_x, later_P) = linked, later
    x = wrap(x + G @ wrap(later_x - mean, model.state_angles), model.state_angles)
    return x, sym(C + sym(G @ later_P @ G.T))
