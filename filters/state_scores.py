"""Scores of a filter's estimate where the true states are known, with gradients with respect to Q and R."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from filters.differentiated.recursion import LOG_SCORE, SQUARES, Wanted
from filters.differentiated.runs import ModelSlopes, Truth, derivatives
from filters.filter import Filter
from filters.likelihood import Likelihood, check_shapes
from thruster_env.core.checks import as_floats, one_of
from thruster_env.model.state_space import StateSpaceModel


def state_score(
    model: StateSpaceModel,
    inputs: np.ndarray,
    measurements: np.ndarray,
    states: np.ndarray,
    q_slopes,
    r_slopes,
    score: str = LOG_SCORE,
    weights: Sequence[float] | np.ndarray | None = None,
    filter: Filter | None = None,
    own_slopes: np.ndarray | None = None,
) -> Likelihood:
    """A score of a filter's estimate at the true states, larger is better, and its gradient.

        log-score:  sum_k log N(x; m, P)
        squares:    -sum_k e' W e,  e = x - m,  W = diag(weights)

    with the mean m and covariance P after each update. The gradient is that of `filters.likelihood.likelihood`'s
    recursion: dm and dP of each parameter, here after the update.

    Args:
        model: holds Q and R, at which the gradient is taken.
        inputs: (B, K, p).
        measurements: (B, K + 1, m); NaN where missing.
        states: (B, K + 1, n), the true ones; NaN where they do not count.
        q_slopes: dQ/dparameter, (parameters, n, n), symmetric.
        r_slopes: dR/dparameter, (parameters, m, m), symmetric.
        score: "log-score" or "squares".
        weights: of the squares, (n,), one by default; those of a log score are one.
        filter: as `filters.likelihood.likelihood` takes it; the (extended) Kalman filter by default.
        own_slopes: as `filters.likelihood.likelihood` takes them.

    Raises:
        ValueError: if shapes do not fit, or for another score or filter.

    Source: Abbeel, Coates, Montemerlo, Ng, Thrun (2005), "Discriminative training of Kalman filters", Robotics:
    Science and Systems, criteria (ii) and (iii); here with exact gradients.
    """
    one_of("score", score, (LOG_SCORE, SQUARES))
    arrays = (inputs, measurements, states, q_slopes, r_slopes)
    inputs, measurements, states, q_slopes, r_slopes = (np.ascontiguousarray(as_floats(a)) for a in arrays)
    n, m, p = model.n, model.m, len(q_slopes)
    sequences = {"inputs": inputs, "measurements": measurements, "states": states}
    wanted_shapes = (*measurements.shape[:2], n), (p, n, n), (p, m, m)
    check_shapes({**sequences, "q_slopes": q_slopes, "r_slopes": r_slopes}, model, *wanted_shapes)
    of_squares = np.ones(n) if weights is None else as_floats(weights)
    if of_squares.shape != (n,):
        raise ValueError(f"weights must have the shape ({n},), but got {of_squares.shape}")
    slopes = ModelSlopes.of(model, p, process_noise_cov=q_slopes, measurement_noise_cov=r_slopes)
    wanted = Wanted(information=False, constants=False, tails=False, score=score)
    truth, arguments = Truth(states, of_squares), (model, inputs, measurements, slopes, wanted)
    out, _ = derivatives(*arguments, truth=truth, used=filter, own_slopes=own_slopes)
    return Likelihood(out[:, 0, 0], out[:, 0, 1:])
