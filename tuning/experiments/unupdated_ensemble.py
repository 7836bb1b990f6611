"""A wrong ensemble Kalman filter that explains published errors: its analysis never updates the ensemble."""

from __future__ import annotations

import numpy as np

from thruster_env.core.checks import covariance_root
from thruster_env.model.affine import AffineModel

_BLOCK = 128  # runs at a time, whose members fit the processor's cache


def unupdated_ensemble_means(
    model: AffineModel, states: np.ndarray, members: int, generator: np.random.Generator
) -> np.ndarray:
    """Means of an ensemble filter whose members run free, with noise-free measurements and zero input.

        members:  x_j = A x_j + w_j,  w_j ~ N(0, Q),  from x_j ~ N(0, P_0), never corrected
        gain:     K = P H' (H P H' + R)^-1,  P the members' sample covariance
        mean:     m = A m,  then  m += K (H x - H m),  x the true state

    A correct filter replaces x_j by x_j + K (z + v_j - H x_j), which keeps P bounded. Here P follows the open
    loop. On an unstable system it grows without bound along the unstable direction e, and K tends to
    e / (H e): the gain assumes exact measurements and ignores the noise across e. It should not be used, so it is
    here and not in `filters`. Starting the truth at the known x_0 = 0 instead lowers the RMSE of the
    open-bladed case by about 1 %.

    Args:
        model: the model, one measurement, for truth and filter alike; prior mean zero, offsets ignored.
        states: true states, (runs, steps + 1, n), index 0 being the initial one.
        members: N, at least 2.
        generator: source of all draws.

    Returns:
        Corrected means, (runs, steps + 1, n).
    """
    a, _, _, c, _ = model.matrices()
    h, r = c[0], model.measurement_noise_cov[0, 0]
    prior_root, q_root = covariance_root(model.prior_cov), covariance_root(model.process_noise_cov)
    means = np.empty_like(states)
    for first in range(0, len(states), _BLOCK):
        truth = states[first : first + _BLOCK]
        shape = len(a), len(truth), members
        ensemble = np.tensordot(prior_root, generator.standard_normal(shape), 1)
        mean = np.zeros((len(truth), len(a)))
        for k in range(states.shape[1]):
            if k > 0:
                noise = np.tensordot(q_root, generator.standard_normal(shape), 1)
                ensemble = np.tensordot(a, ensemble, 1) + noise
                mean = mean @ a.T
            deviation = ensemble - ensemble.mean(axis=2, keepdims=True)
            predicted = np.tensordot(h, deviation, 1)  # (runs, N)
            cross_cov = np.einsum("irj,rj->ri", deviation, predicted) / (members - 1)  # P H'
            gain = cross_cov / (cross_cov @ h + r)[:, None]
            mean = mean + gain * ((truth[:, k] - mean) @ h)[:, None]
            means[first : first + _BLOCK, k] = mean
    return means
