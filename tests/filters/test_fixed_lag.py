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
    EstimateStates,
    ExtendedKalmanFilter,
    IteratedExtendedKalmanFilter,
    KalmanFilter,
    UnscentedKalmanFilter,
    run,
    smooth,
)
from filters.smoothers import WithSmoother
from tests.models import KEY, affine, pendulum, scalar_model, simulated, wide_model
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


def as_augmented_state(model, inputs, measurements, lag):
    """The oldest of x_k, ..., x_{k-lag} by a plain Kalman filter whose state they are, at each step."""
    a, b, offset, c, shift = model.matrices()
    n, size = model.n, (lag + 1) * model.n
    big_a, big_c, q = np.zeros((size, size)), np.zeros((model.m, size)), np.zeros((size, size))
    big_a[:n, :n], big_c[:, :n], q[:n, :n] = a, c, model.process_noise_cov
    big_a[n:, :-n] = np.eye(size - n)
    x = np.tile(model.prior_mean, lag + 1)  # all are the state at the start
    p = np.kron(np.ones((lag + 1, lag + 1)), model.prior_cov)
    means, covs = [], []
    for k, z in enumerate(measurements):
        if k:
            moved = big_a @ x
            moved[:n] += b @ inputs[k - 1] + offset
            x, p = moved, big_a @ p @ big_a.T + q
        seen = ~np.isnan(z)
        h, r = big_c[seen], model.measurement_noise_cov[np.ix_(seen, seen)]
        gain = np.linalg.solve(h @ p @ h.T + r, h @ p).T
        x, p = x + gain @ (z - shift - c @ x[:n])[seen], p - gain @ h @ p
        means.append(x[-n:])
        covs.append(p[-n:, -n:])
    return np.array(means), np.array(covs)


@pytest.mark.parametrize("kind", [KalmanFilter, ExtendedKalmanFilter, UnscentedKalmanFilter])
@pytest.mark.parametrize("lag", [0, 1, 6])
@pytest.mark.usefixtures("as_python")
def test_on_an_affine_model_it_is_the_filter_of_the_augmented_state(kind, lag):
    model = wide_model()
    inputs, measurements = simulated(model, 20, level=1.0, missing=0.25)
    found = lagged(kind(model=model), inputs[0], measurements[0], lag)
    for one, other in zip(found, as_augmented_state(model, inputs[0], measurements[0], lag), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9)


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
        np.testing.assert_allclose(means[-1], full.means[0, 0], rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(covs[-1], full.covs[0, 0], rtol=1e-10, atol=1e-12)


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


@pytest.mark.usefixtures("as_python")
def test_nothing_is_carried_back_over_a_restart():
    filter_ = KalmanFilter(model=scalar_model(b=[[1e200]]))
    inputs = np.zeros((9, 1))
    inputs[4] = 1e150  # makes the state infinite, and the filter restarts
    measurements = np.random.default_rng(3).normal(6.0, 1.0, size=(10, 1))
    means, _ = lagged(filter_, inputs, measurements, 3)
    batch = smooth(filter_, np.array([KEY]), inputs[None], measurements[None], 3)
    np.testing.assert_allclose(means[3:], batch.means[0, :7], rtol=1e-12)


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


@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
def test_each_copy_of_a_vector_env_is_a_single_env_is_the_batch(mode):
    name, lag, length, copies = "BowThrusterTracking-v0", 3, 7, 3
    vector = gym.make_vec(name, num_envs=copies, max_episode_steps=length, autoreset_mode=mode)
    vector = EstimateStates(vector, "ekf", smoothing_lag=lag)
    singles = [
        EstimateState(gym.make(name, max_episode_steps=length), "ekf", smoothing_lag=lag) for _ in range(copies)
    ]
    _, info = vector.reset(seed=5)
    told = [single.reset(seed=5 + i)[1] for i, single in enumerate(singles)]
    seen, actions = (
        [[one["measurement"]] for one in told],
        np.random.default_rng(0).uniform(-9, 9, (20, copies, 1)),
    )
    ended, first = np.zeros(copies, dtype=bool), []
    for k, action in enumerate(actions.astype(np.float32)):
        _, _, terminated, truncated, info = vector.step(action)
        for i, single in enumerate(singles):
            if mode == "NextStep" and ended[i]:
                told[i] = single.reset()[1]
            else:
                _, _, *ends, told[i] = single.step(action[i])
                seen[i].append(told[i]["measurement"])
                if k < length:
                    first.append(told[i]["smoothed"])
                if mode == "SameStep" and any(ends):
                    last = info["final_info"]["smoothed"][i]
                    np.testing.assert_allclose(last, told[i]["smoothed"], rtol=1e-9, atol=1e-12)
                    told[i] = single.reset()[1]
            if not (mode == "Disabled" and ended[i]):
                for key in ("smoothed", "smoothed_cov"):
                    np.testing.assert_allclose(info[key][i], told[i][key], rtol=1e-9, atol=1e-12)
        ended = terminated | truncated
        if mode == "Disabled" and ended.any():
            _, info = vector.reset(options={"reset_mask": ended})
            for i in np.flatnonzero(ended):
                told[i] = singles[i].reset()[1]
                np.testing.assert_allclose(info["smoothed"][i], told[i]["smoothed"], rtol=1e-9, atol=1e-12)
    measured = np.array([one[: length + 1] for one in seen])
    inputs = np.swapaxes(actions[:length], 0, 1).astype(np.float32).astype(float)
    batch = smooth(singles[0].filter, None, inputs, measured, lag)
    whole = np.array(first).reshape(length, copies, -1)
    np.testing.assert_allclose(whole[lag - 1 :].swapaxes(0, 1), batch.means[:, : length + 1 - lag], rtol=1e-9)


def test_what_it_cannot_smooth_and_wrong_lags_are_refused():
    env = gym.make("BowThruster-v0")
    with pytest.raises(
        ValueError, match=r"a smoothing_lag needs a filter of kf, ekf, iekf, ukf, ckf, but got 'enkf'"
    ):
        EstimateState(env, "enkf", smoothing_lag=3)
    with pytest.raises(ValueError, match="smoothing_lag must be a whole number of at least 0, but got -1"):
        EstimateState(env, "ekf", smoothing_lag=-1)
    filter_ = EnsembleKalmanFilter(model=pendulum())
    with pytest.raises(ValueError, match="a smoothing_lag needs"):
        WithSmoother(filter_.session(), filter_, 2)
