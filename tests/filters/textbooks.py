"""Filters as textbooks have them, of the functions of a model, in NumPy."""

import numpy as np

from tests.oracles import kalman_update
from thruster_env.core.angles import difference


def extended_filter(model, inputs, measurements):
    """Means (K + 1, n), covariances, innovations and their covariances of one run, by the model's own Jacobians.

    Channels that are NaN are left out, so innovations are lists of arrays.
    """
    x, p, c, angles = model.prior_mean, model.prior_cov, model.constants, model.shape.state_angles
    found = []
    for k, z in enumerate(measurements):
        if k:
            u = tuple(inputs[k - 1])
            for _ in range(model.substeps):
                f = np.array(model.transition_jacobian(tuple(x), u, c))
                x, p = np.array(model.transition(tuple(x), u, c)), f @ p @ f.T
            p = p + model.process_noise_cov
        there = ~np.isnan(z)
        h = np.array(model.observe_jacobian(tuple(x), c))[there]
        v = difference(z, model.observe(tuple(x), c), model.shape.measurement_angles)[there]
        x, p, s = kalman_update(x, p, v, h, model.measurement_noise_cov[np.ix_(there, there)])
        x = difference(x, 0.0, angles)
        found.append((x, p, v, s))
    means, covs, innovations, innovation_covs = zip(*found, strict=True)
    return np.array(means), np.array(covs), innovations, innovation_covs
