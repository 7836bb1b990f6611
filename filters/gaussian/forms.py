"""The square-root and the UD form of the extended Kalman filter, which keep twice the digits of P.

An orthogonal Theta from the right makes a matrix lower triangular:

    predict: [F L, Q^(1/2)] Theta = [L, 0]
    update:  [[R^(1/2), H L], [0, L]] Theta = [[S^(1/2), 0], [K S^(1/2), L]],
             x += (K S^(1/2)) S^(-1/2) v

No covariance is ever formed from another: P = L L' is for the reader only. L keeps twice the digits that P would,
of states known a million times better than others.

Source: Kaminski, Bryson, Schmidt (1971), "Discrete square root filtering: a survey of current techniques", IEEE
Trans. Automatic Control 16(6).

The UD form is

    predict: U D U' = [F U, Q^(1/2)] diag(D, I) [F U, Q^(1/2)]',  by Gram and Schmidt's method with these weights
    update:  one channel of R^(-1/2) z after the other, each a scalar whose noise has variance one

Both factors lie in one matrix, D on its diagonal.

Source: Bierman (1977), Factorization Methods for Discrete Sequential Estimation, chapter V; Thornton (1976),
"Triangular covariance factorizations for Kalman filtering".
"""

from __future__ import annotations

from filters.algebra import upper
from filters.algebra.blocks import factor_of, forward_quotient, hstack, part, triangle, vstack, zeros
from filters.algebra.operations import only, present, uncorrelated, wrap
from filters.algebra.points import root, square
from filters.algebra.samples import density
from filters.pages.page import Page

# The square-root form of the Kalman filter: the root L of P = L L' is carried, by orthogonal steps.


def initial_root(model):
    """The root of the prior covariance."""
    return {"L": model.prior_root}


def represent_root(model, x, P):
    """The mean and the root L of P."""
    return x, model.extras["L"]


def propagate_root(model, x, L, u):
    """Propagate mean and root by one substep."""
    return wrap(model.f(x, u), model.state_angles), model.F(x, u) @ L


def add_process_noise_root(model, x, L):
    """Add Q at the end of a step."""
    L = triangle(hstack(L, model.Q_root))
    return x, square(L), {"L": L}


def update_root(model, x, P, z):
    """Update with the measurement z; NaN marks missing channels."""
    n, m, measured, L = len(x), len(z), present(z), model.extras["L"]
    H, R = only(measured, model.H(x)), uncorrelated(measured, model.R)
    v = only(measured, wrap(z - model.h(x), model.measurement_angles))
    both = triangle(vstack(hstack(root(R), H @ L), hstack(zeros(L, n, m), L)))
    return root_result(model, x, both, v, measured)


def root_result(model, x, both, v, measured):
    """The results of an update, from the triangle [[S^(1/2), 0], [K S^(1/2), L]]."""
    n, m = len(x), len(v)
    of_s, of_gain, L = part(both, 0, 0, m, m), part(both, m, 0, n, m), part(both, m, m, n, n)
    x = wrap(x + of_gain @ forward_quotient(of_s, v), model.state_angles)
    return x, square(L), v, square(of_s), density(v, factor_of(of_s), measured), {"L": L}


SQUARE_ROOT = Page(propagate_root, add_process_noise_root, update_root, represent_root, initial_root)


# The UD form of the Kalman filter: a unit upper triangular U and a diagonal D with P = U D U' are carried.


def initial_ud(model):
    """The factors of the prior covariance."""
    return {"UD": upper.factors(model.prior_root)}


def represent_ud(model, x, P):
    """The mean and U; D is read from the extras."""
    return x, upper.unit_upper(model.extras["UD"])


def propagate_ud(model, x, U, u):
    """Propagate the mean and U by one substep."""
    return wrap(model.f(x, u), model.state_angles), model.F(x, u) @ U


def add_process_noise_ud(model, x, U):
    """Add Q at the end of a step."""
    UD = upper.weighted_factors(hstack(U, model.Q_root), model.extras["UD"])
    return x, square(upper.upper_root(UD)), {"UD": UD}


def update_ud(model, x, P, z):
    """Update with the measurement z; NaN marks missing channels."""
    measured, UD = present(z), model.extras["UD"]
    H, R_root = only(measured, model.H(x)), root(uncorrelated(measured, model.R))
    v = only(measured, wrap(z - model.h(x), model.measurement_angles))
    white = forward_quotient(R_root, H)
    of_s = triangle(hstack(R_root, H @ upper.upper_root(UD)))
    x = wrap(x + upper.measured_gain(UD, white) @ forward_quotient(R_root, v), model.state_angles)
    UD = upper.measured_factors(UD, white)
    return x, square(upper.upper_root(UD)), v, square(of_s), density(v, factor_of(of_s), measured), {"UD": UD}


UD = Page(propagate_ud, add_process_noise_ud, update_ud, represent_ud, initial_ud)
