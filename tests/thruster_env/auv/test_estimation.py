"""Filters on a vehicle that sails about at 20 Hz: consistent, and as accurate as the Riccati recursion says."""

import math

import numpy as np
import pytest

from filters import make_filter, run
from filters.consistency.nees import normalized_squares
from thruster_env.auv.model import auv_model
from thruster_env.core.angles import difference
from thruster_env.core.compiled import interpreted
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
    for k in range(runs):
        rng = np.random.default_rng((seed, k))
        for i, (low, high) in enumerate(((2.0, 4.0), (-plane, plane), (-plane, plane))):
            inputs[k, :, i] = levels(rng, steps, low, high)
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


RUNS, STEPS = 10, 700


@pytest.fixture(scope="module")
def problem():
    with interpreted():  # 7000 steps are simulated sooner than compiled
        model = sailing_model()
        return model, *sailing(model, RUNS, STEPS)


@pytest.mark.slow
def test_the_extended_filter_of_eight_states_is_consistent_and_meets_the_reference(problem):
    """The NEES of a run of 30 s scatters by 0.55 about 8: 0.7 is four standard errors of the mean of ten.

    Pitch is correlated for seconds, so its RMSE is the least certain: by 4 %. With 50 runs of 60 s (seeds 0 to 49)
    extended and unscented filter have NEES 7.94 +- 0.06 and all RMSE within 1.8 % of the reference.
    """
    model, keys, inputs, truth = problem
    extended = make_filter("ekf", model)
    estimates = run(extended, keys, inputs, truth.measurements)
    with interpreted():
        again = run(extended, keys[:1], inputs[:1, :10], truth.measurements[:1, :11])
    np.testing.assert_allclose(estimates.means[:1, :11], again.means, rtol=1e-9, atol=1e-12)
    rmse, nees = scores(model, truth, estimates)
    assert nees.mean() == pytest.approx(8.0, abs=0.7)
    assert 0.1 < nees.std(ddof=1) < 0.9
    ratio = rmse / riccati_reference(model, inputs[:3, :400])
    assert (np.abs(ratio - 1.0) < [0.03, 0.03, 0.03, 0.05, 0.05, 0.03, 0.05, 0.12]).all(), ratio


@pytest.mark.usefixtures("as_python")
def test_the_unscented_filter_agrees_with_the_extended_one(problem):
    """Nonlinearity is weak between measurements: they differ by a hundredth of a standard deviation."""
    model, keys, inputs, truth = problem
    given = keys[:1], inputs[:1, :25], truth.measurements[:1, :26]
    extended, unscented = (run(make_filter(name, model), *given) for name in ("ekf", "ukf"))
    deviations = np.sqrt(np.diagonal(extended.covs, axis1=2, axis2=3))
    assert (np.abs(unscented.means - extended.means) < 0.05 * deviations).all()
    np.testing.assert_allclose(unscented.covs[:, 10:], extended.covs[:, 10:], rtol=0.05, atol=1e-9)
