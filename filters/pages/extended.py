"""The extended Kalman filter, which is the Kalman filter where the model is affine.

    predict: x = f(x, u),  P = F P F' + Q,  F = df/dx at the last mean
    update:  v = z - h(x),  S = H P H' + R,  K = P H' S^-1,  x += K v,  P = (I - K H) P (I - K H)' + K R K'

Source: Jazwinski (1970), Stochastic Processes and Filtering Theory, section 8.3.
"""

from __future__ import annotations

from numerics.algebra.densities import log_density
from numerics.algebra.operations import divide, joseph, only, present, sym, uncorrelated, wrap


def advance(model, x, P, u):
    """One of the model's substeps."""
    F = model.F(x, u)
    return wrap(model.f(x, u), model.state_angles), sym(F @ P @ F.T)


def settle(model, x, P):
    """The end of a step."""
    return x, sym(P + model.Q)


def update(model, x, P, z):
    """The measurement z; channels that are NaN are missing."""
    seen = present(z)
    H, R = only(seen, model.H(x)), uncorrelated(seen, model.R)
    v = only(seen, wrap(z - model.h(x), model.measurement_angles))
    S = sym(H @ P @ H.T + R)
    K = divide(P @ H.T, S)
    return wrap(x + K @ v, model.state_angles), joseph(P, K, H, R), v, S, log_density(v, S, seen)
