"""The estimation problem of a vehicle that sails about: random thrusts and planes, and its truth."""

import math

import numpy as np

from filters.consistency.nees import normalized_squares
from thruster_env.auv.model import auv_model
from thruster_env.core.angles import difference
from thruster_env.core.streams import episode_keys
from thruster_env.model.simulate import simulate

SETTLED = 100  # steps of 0.05 s that are not scored


def sailing_model(**changes):
    """Eight states, the papers' measured quantities with 1e-3, at 20 Hz."""
    return auv_model(**{"states": "motion", "sensors": "papers", **changes})


def levels(rng, steps, low, high):
    """Uniform numbers (steps,), each held for 3 to 8 s."""
    out = np.empty(0)
    while len(out) < steps:
        out = np.append(out, np.full(rng.integers(60, 160), rng.uniform(low, high)))
    return out[:steps]


def sailing(model, runs, steps, seed=0):
    """Keys, inputs (runs, steps, 3), and truth of so many runs; planes within 6 deg."""
    keys, plane = episode_keys(range(seed, seed + runs)), math.radians(6.0)
    inputs = np.empty((runs, steps, 3))
    for run in range(runs):
        rng = np.random.default_rng((seed, run))
        for i, (low, high) in enumerate(((2.0, 4.0), (-plane, plane), (-plane, plane))):
            inputs[run, :, i] = levels(rng, steps, low, high)
    return keys, inputs, simulate(model, keys, inputs)


def scores(model, truth, estimates):
    """RMSE of each state (n,), and the mean NEES of each run (B,), over settled steps; errors of yaw wrapped."""
    angles = [state.angle for state in model.states]
    errors = difference(estimates.means, truth.states, angles)[:, SETTLED:]
    covs = estimates.covs[:, SETTLED:]
    return np.sqrt(np.mean(errors**2, axis=(0, 1))), normalized_squares(errors, covs).mean(axis=1)


def riccati_reference(model, inputs):
    """Root of the mean variances that the Riccati recursion has along noise-free paths, for each state (n,)."""
    c, h, variances = (
        model.constants,
        np.array(model.observe_jacobian(tuple(model.prior_mean), model.constants)),
        [],
    )
    for given in inputs:
        x, p = tuple(model.prior_mean.tolist()), model.prior_cov
        for k in range(len(given) + 1):
            if k > 0:
                u = tuple(given[k - 1].tolist())
                f = np.asarray(model.transition_jacobian(x, u, c))
                x = model.transition(x, u, c)
                p = f @ p @ f.T + model.process_noise_cov
            s = h @ p @ h.T + model.measurement_noise_cov
            p = p - p @ h.T @ np.linalg.solve(s, h @ p)
            if k >= SETTLED:
                variances.append(np.diag(p))
    return np.sqrt(np.mean(variances, axis=0))
