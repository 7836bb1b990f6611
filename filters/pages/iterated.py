"""The iterated extended Kalman filter: the measurement is linearised again where the update ends.

    predict: that of the extended filter
    update:  x_0 = x,  x_{i+1} = x + K (z - h(x_i) - H (x - x_i)),  H = dh/dx at x_i,  K = P H' (H P H' + R)^-1,
             at last P = (I - K H) P (I - K H)' + K R K'

The innovation and S are those of the first iteration, and so assess the prediction.

Source: Bell, Cathey (1993), "The iterated Kalman filter update as a Gauss-Newton method", IEEE Trans. Automatic
Control 38(2).
"""

from __future__ import annotations

from filters.pages.extended import advance, settle
from numerics.algebra.densities import log_density
from numerics.algebra.operations import divide, joseph, only, present, sym, uncorrelated, wrap

__all__ = ["advance", "settle", "update"]


def update(model, x, P, z, iterations):
    """The measurement z, linearised so many times; channels that are NaN are missing."""
    seen, R, at, told = present(z), uncorrelated(present(z), model.R), x, []
    for i in range(iterations):
        H, y = only(seen, model.H(at)), model.h(at)
        on_tangent = y + H @ (x - at) if i else y
        v = only(seen, wrap(z - on_tangent, model.measurement_angles))
        S = sym(H @ P @ H.T + R)
        K = divide(P @ H.T, S)
        at = x + K @ v
        told.append((v, S))
    v, S = told[0]
    return wrap(at, model.state_angles), joseph(P, K, H, R), v, S, log_density(v, S, seen)
