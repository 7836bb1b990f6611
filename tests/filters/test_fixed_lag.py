"""Smoothing some steps behind a filter in closed loop, against theory, an augmented state, RTS and FilterPy."""

import pickle

import gymnasium as gym
import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from filters import (
    CubatureKalmanFilter,
    EnsembleKalmanFilter,
    EstimateState,
    ExtendedKalmanFilter,
    IteratedExtendedKalmanFilter,
    KalmanFilter,
    UnscentedKalmanFilter,
    run,
    smooth,
)
from filters.smoothers import WithSmoother
from tests.filters.checks import refused
from tests.models import KEY, affine, pendulum, simulated, wide_model
from tests.oracles import each_close
from thruster_env.core.compiled import interpreted

KINDS = {
    "kf": KalmanFilter,
    "ekf": ExtendedKalmanFilter,
    "iekf": IteratedExtendedKalmanFilter,
    "ukf": UnscentedKalmanFilter,
    "ckf": CubatureKalmanFilter,
}


def lagged(filter_, inputs, measurements, lag):
    """Means (K + 1, n) and covariances that a session with a smoother tells step by step."""
    session = WithSmoother(filter_.session(), filter_, lag)
    session.start(KEY, measurements[0])
    told = [session.smoothed()]
    for u, z in zip(inputs, measurements[1:], strict=True):
        session.step(u, z)
        told.append(session.smoothed())
    return [np.array(part) for part in zip(*told, strict=True)]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.usefixtures("as_python")
def test_step_by_step_it_is_the_smoother_of_the_batch(kind):
    model = wide_model() if kind == "kf" else pendulum()
    filter_ = KINDS[kind](model=model)
    inputs, measurements = simulated(model, 15, missing=0.2)
    for lag in (0, 4):
        means, covs = lagged(filter_, inputs[0], measurements[0], lag)
        batch = smooth(filter_, np.array([KEY]), inputs, measurements, lag)
        np.testing.assert_allclose(means[lag:], batch.means[0, : 16 - lag], rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(covs[lag:], batch.covs[0, : 16 - lag], rtol=1e-10, atol=1e-12)
    full = smooth(filter_, np.array([KEY]), inputs, measurements)
    for lag in (15, 40):  # the state at the start, given all that was measured up to each step
        means, covs = lagged(filter_, inputs[0], measurements[0], lag)
        each_close((means[-1], covs[-1]), (full.means[0, 0], full.covs[0, 0]), rtol=1e-10, atol=1e-12)


def moving_target():
    """Position and speed of a target; the position is measured."""
    noise = {"q": 0.01 * np.array([[1 / 3, 1 / 2], [1 / 2, 1.0]]), "r": [1.0]}
    prior = {"mean": [0.0, 0.0], "cov": [1.0, 0.1]}
    return affine([[1.0, 1.0], [0.0, 1.0]], np.zeros((2, 0)), [[1.0, 0.0]], **noise, **prior)


def covariances_in_theory(model, lags):
    """Of the fixed-lag smoother when it has settled, at lags 0 ... lags: each later innovation adds information.

    P_L = M - M (sum over i = 0 ... L of (A_c')^i C' S^-1 C A_c^i) M, where M is the prediction's covariance and
    A_c = A - A K C the predictor's closed loop (Anderson, Moore 1979, section 7.3).
    """
    a, _, _, c, _ = model.matrices()
    m = solve_discrete_are(a.T, c.T, model.process_noise_cov, model.measurement_noise_cov)
    s = c @ m @ c.T + model.measurement_noise_cov
    closed, moved, information, found = a - a @ m @ c.T @ np.linalg.solve(s, c), np.eye(len(a)), 0.0, []
    for _ in range(lags + 1):
        information = information + moved.T @ c.T @ np.linalg.solve(s, c @ moved)
        found.append(m - m @ information @ m)
        moved = closed @ moved
    return np.array(found)


@pytest.mark.slow
def test_when_it_has_settled_its_errors_fall_with_the_lag_as_in_theory():
    model, lags, steps, settled = moving_target(), 12, 400, 100
    theory = covariances_in_theory(model, lags)
    rng, count = np.random.default_rng(4), 400
    states, z = np.zeros((count, steps + 1, 2)), np.zeros((count, steps + 1, 1))
    roots = np.linalg.cholesky(model.process_noise_cov), np.sqrt(model.prior_cov)
    x = rng.normal(size=(count, 2)) @ roots[1]
    for k in range(steps + 1):
        if k:
            x = x @ model.matrices()[0].T + rng.normal(size=(count, 2)) @ roots[0].T
        states[:, k], z[:, k, 0] = x, x[:, 0] + rng.normal(size=count)
    filter_, inputs = KalmanFilter(model=model), np.zeros((count, steps, 0))
    were = np.inf
    for lag in (0, 1, 3, 6, 12):
        found = smooth(filter_, None, inputs, z, lag)
        np.testing.assert_allclose(found.covs[0, steps - lag], theory[lag], rtol=1e-7)
        squares = ((found.means - states)[:, settled : steps - lag] ** 2).mean(
            axis=1
        )  # (count, 2), of single runs
        mean, error = squares.mean(axis=0), squares.std(axis=0) / np.sqrt(count)
        assert (abs(mean - np.diag(theory[lag])) < 3.5 * error).all()  # 99.95 % of right filters pass each time
        assert (mean < were).all()
        were = mean
    assert theory[12][0, 0] < 0.5 * theory[0][0, 0]


def test_it_is_nearer_to_the_truth_than_filterpy_s():
    """FilterPy's recursion smooths the updated estimate by A - K C; right are the predicted one and A - A K C."""
    peer = pytest.importorskip("filterpy.kalman")
    model, lag, steps = moving_target(), 4, 3000
    rng, x = np.random.default_rng(6), np.zeros(2)
    root, (a, _, _, c, _) = np.linalg.cholesky(model.process_noise_cov), model.matrices()
    theirs = peer.FixedLagSmoother(dim_x=2, dim_z=1, N=lag)
    theirs.F, theirs.H, theirs.Q, theirs.R = a, c, model.process_noise_cov, model.measurement_noise_cov
    theirs.x, theirs.P = np.zeros((2, 1)), model.prior_cov.copy()
    states, z = np.zeros((steps + 1, 2)), np.full((steps + 1, 1), np.nan)
    for k in range(1, steps + 1):  # its first step predicts, so ours begins without a measurement
        states[k] = x = a @ x + root @ rng.normal(size=2)
        z[k] = x[0] + rng.normal()
        theirs.smooth(z[k])
    filter_ = KalmanFilter(model=model)
    filtered = run(filter_, None, np.zeros((1, steps, 0)), z[None])
    np.testing.assert_allclose(theirs.x[:, 0], filtered.means[0, -1], rtol=1e-9)  # the filters are the same
    ours = smooth(filter_, None, np.zeros((1, steps, 0)), z[None], lag)
    their_errors = np.array(theirs.xSmooth)[lag : steps - lag, :, 0] - states[1 + lag : steps + 1 - lag]
    our_errors = (ours.means[0] - states)[1 + lag : steps + 1 - lag]
    assert (np.mean(our_errors**2, axis=0) < np.mean(their_errors**2, axis=0)).all()


def test_a_session_goes_on_after_a_pickle():
    model = pendulum()
    filter_ = ExtendedKalmanFilter(model=model)
    inputs, measurements = simulated(model, 8)
    with interpreted():
        session = WithSmoother(filter_.session(), filter_, 3)
        session.start(KEY, measurements[0, 0])
        for k in range(8):
            if k == 4:
                session = pickle.loads(pickle.dumps(session))
            session.step(inputs[0, k], measurements[0, k + 1])
        means, _ = lagged(filter_, inputs[0], measurements[0], 3)
        np.testing.assert_array_equal(session.smoothed()[0], means[-1])


def test_what_it_cannot_smooth_and_wrong_lags_are_refused():
    env = gym.make("BowThruster-v0")
    rule = r"a smoothing_lag needs a filter of kf, ekf, iekf, ukf, ckf, but got 'enkf'"
    refused(rule, EstimateState, env, "enkf", smoothing_lag=3)
    with pytest.raises(ValueError, match="smoothing_lag must be a whole number of at least 0, but got -1"):
        EstimateState(env, "ekf", smoothing_lag=-1)
    filter_ = EnsembleKalmanFilter(model=pendulum())
    refused("a smoothing_lag needs", WithSmoother, filter_.session(), filter_, 2)
