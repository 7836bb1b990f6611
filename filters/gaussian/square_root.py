"""The square-root form of the Kalman filter: the root L of P = L L' is carried, by orthogonal steps.

An orthogonal Theta from the right makes a matrix lower triangular:

    predict: [F L, Q^(1/2)] Theta = [L, 0]
    update:  [[R^(1/2), H L], [0, L]] Theta = [[S^(1/2), 0], [K S^(1/2), L]],
             x += (K S^(1/2)) S^(-1/2) v

No covariance is ever formed from another: P = L L' is for the reader only. L keeps twice the digits that P would,
of states known a million times better than others.

Source: Kaminski, Bryson, Schmidt (1971), "Discrete square root filtering: a survey of current techniques", IEEE
Trans. Automatic Control 16(6).
"""

from __future__ import annotations

from filters.algebra.blocks import factor_of, forward_quotient, hstack, part, triangle, vstack, zeros
from filters.algebra.densities import density
from filters.algebra.operations import only, present, uncorrelated, wrap
from filters.algebra.points import root, square
from filters.pages.page import Page


def start(model):
    """The root of the prior covariance."""
    return {"L": model.prior_root}


def begin(model, x, P):
    """The mean and the root that is kept."""
    return x, model.kept["L"]


def advance(model, x, L, u):
    """One of the model's substeps."""
    return wrap(model.f(x, u), model.state_angles), model.F(x, u) @ L


def settle(model, x, L):
    """The end of a step."""
    L = triangle(hstack(L, model.Q_root))
    return x, square(L), {"L": L}


def update(model, x, P, z):
    """The measurement z; channels that are NaN are missing."""
    n, m, seen, L = len(x), len(z), present(z), model.kept["L"]
    H, R = only(seen, model.H(x)), uncorrelated(seen, model.R)
    v = only(seen, wrap(z - model.h(x), model.measurement_angles))
    both = triangle(vstack(hstack(root(R), H @ L), hstack(zeros(L, n, m), L)))
    return updated(model, x, both, v, seen)


def updated(model, x, both, v, seen):
    """What an update returns, of the triangle [[S^(1/2), 0], [K S^(1/2), L]]."""
    n, m = len(x), len(v)
    of_s, of_gain, L = part(both, 0, 0, m, m), part(both, m, 0, n, m), part(both, m, m, n, n)
    x = wrap(x + of_gain @ forward_quotient(of_s, v), model.state_angles)
    return x, square(L), v, square(of_s), density(v, factor_of(of_s), seen), {"L": L}


SQUARE_ROOT = Page(advance, settle, update, begin, start)
