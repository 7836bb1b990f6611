"""The UD form of the Kalman filter: a unit upper triangular U and a diagonal D with P = U D U' are carried.

    predict: U D U' = [F U, Q^(1/2)] diag(D, I) [F U, Q^(1/2)]',  by Gram and Schmidt's method with these weights
    update:  one channel of R^(-1/2) z after the other, each a scalar whose noise has variance one

It has the digits of the square-root form. Both factors lie in one matrix, D on its diagonal.

Source: Bierman (1977), Factorization Methods for Discrete Sequential Estimation, chapter V; Thornton (1976),
"Triangular covariance factorizations for Kalman filtering".
"""

from __future__ import annotations

from filters.algebra import upper
from filters.algebra.blocks import factor_of, forward_quotient, hstack, triangle
from filters.algebra.densities import density
from filters.algebra.operations import only, present, uncorrelated, wrap
from filters.algebra.points import root, square
from filters.pages.page import Page


def start(model):
    """The factors of the prior covariance."""
    return {"UD": upper.factors(model.prior_root)}


def begin(model, x, P):
    """The mean and U; D stays where it is."""
    return x, upper.unit_upper(model.kept["UD"])


def advance(model, x, U, u):
    """One of the model's substeps."""
    return wrap(model.f(x, u), model.state_angles), model.F(x, u) @ U


def settle(model, x, U):
    """The end of a step."""
    UD = upper.weighted_factors(hstack(U, model.Q_root), model.kept["UD"])
    return x, square(upper.upper_root(UD)), {"UD": UD}


def update(model, x, P, z):
    """The measurement z; channels that are NaN are missing."""
    seen, UD = present(z), model.kept["UD"]
    H, R_root = only(seen, model.H(x)), root(uncorrelated(seen, model.R))
    v = only(seen, wrap(z - model.h(x), model.measurement_angles))
    white = forward_quotient(R_root, H)
    of_s = triangle(hstack(R_root, H @ upper.upper_root(UD)))
    x = wrap(x + upper.measured_gain(UD, white) @ forward_quotient(R_root, v), model.state_angles)
    UD = upper.measured_factors(UD, white)
    return x, square(upper.upper_root(UD)), v, square(of_s), density(v, factor_of(of_s), seen), {"UD": UD}


UD = Page(advance, settle, update, begin, start)
