"""The information form of the Kalman filter: the update works on the inverse of the covariance.

    update: Y = P^-1 + H' R^-1 H,  P = Y^-1,  x += P H' R^-1 v

Every channel adds its own information H' R^-1 H, so many channels and few states are cheap; no gain and no
inverse of S are needed, which is here for the likelihood only. P must be positive definite throughout. Inverses
are products W' W of inverse Cholesky factors W, symmetric and positive by construction.

Source: Anderson, Moore (1979), Optimal Filtering, section 6.3.
"""

from __future__ import annotations

from filters.algebra.blocks import inverse_of
from filters.algebra.densities import log_density
from filters.algebra.operations import divide, only, present, sym, uncorrelated, wrap
from filters.gaussian.extended import advance, settle
from filters.pages.page import Page


def update(model, x, P, z):
    """The measurement z; channels that are NaN are missing."""
    seen = present(z)
    H, R = only(seen, model.H(x)), uncorrelated(seen, model.R)
    v = only(seen, wrap(z - model.h(x), model.measurement_angles))
    S = sym(H @ P @ H.T + R)
    W = divide(H.T, R)  # H' R^-1
    P = inverse_of(sym(inverse_of(P) + W @ H))
    return wrap(x + P @ (W @ v), model.state_angles), P, v, S, log_density(v, S, seen)


INFORMATION = Page(advance, settle, update)
