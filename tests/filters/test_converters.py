"""Filters of other packages as ours: the same numbers on their own data, to 1e-9."""

import numpy as np
import pytest

import filters

F, H = np.array([[1.0, 0.1], [0.0, 0.9]]), np.array([[1.0, 0.0]])
Q, R = np.array([[0.02, 0.01], [0.01, 0.05]]), np.array([[0.3]])
Z = np.cumsum(np.random.default_rng(0).normal(size=60))


def close(ours, theirs):
    np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-9)


def filterpy_filter(B=None):
    kalman = pytest.importorskip("filterpy.kalman")
    kf = kalman.KalmanFilter(dim_x=2, dim_z=1, dim_u=0 if B is None else 1)
    kf.F, kf.H, kf.Q, kf.R, kf.B = F.copy(), H.copy(), Q.copy(), R.copy(), B
    kf.x, kf.P = np.array([[0.5], [-1.0]]), np.array([[2.0, 0.3], [0.3, 1.0]])
    return kf


@pytest.mark.parametrize("update_first", [False, True])
def test_filterpy_gives_the_same_means_and_covariances(update_first):
    kf = filterpy_filter()
    ours = filters.run(filters.from_filterpy(kf, update_first=update_first), Z)
    means, covs, _, _ = kf.batch_filter(Z, update_first=update_first)
    close(ours.means, means[..., 0])
    close(ours.covs, covs)


def test_filterpy_with_inputs_from_its_present_state_and_back():
    b = np.array([[0.0], [0.5]])
    kf, u = filterpy_filter(b), np.sin(np.arange(60.0))
    for k in range(10):
        kf.predict(u[k])
        kf.update(Z[k])
    filter_ = filters.from_filterpy(kf, first_input=u[10:11])
    ours = filters.run(filter_, inputs=u[11:], measurements=Z[10:])
    back = filters.to_filterpy(filter_)
    back.update(Z[10])
    close(back.x[:, 0], ours.means[0])
    for k in range(10, 60):
        kf.predict(u[k])
        kf.update(Z[k])
    close(kf.x[:, 0], ours.means[-1])
    close(kf.P, ours.covs[-1])


def test_filterpy_with_an_input_for_each_measurement_predicts_before_the_first():
    kf, u = filterpy_filter(np.array([[0.3], [0.5]])), np.sin(0.4 + np.arange(60.0))
    filter_, after = filters.from_filterpy(kf), filters.from_filterpy(kf, update_first=True)
    started = filters.from_filterpy(kf, first_input=u[:1])
    means, covs, _, _ = kf.batch_filter(Z, us=u)
    runs = (
        filters.run(filter_, inputs=u, measurements=Z),
        filters.run(filter_, inputs=u[:, None, None], measurements=Z[:, None, None]),
        filters.run(after, inputs=u, measurements=Z, update_first=False),
        filters.run(started, inputs=u[1:], measurements=Z),
    )
    for run in runs:
        close(run.means, means[..., 0])
        close(run.covs, covs)
    with pytest.raises(ValueError, match="one fewer than measurements where the first is first_input="):
        filters.run(started, inputs=u, measurements=Z)
    with pytest.raises(ValueError, match="has done so: from_filterpy.kf, update_first=True"):
        filters.run(filter_, inputs=u, measurements=Z, update_first=False)


def test_pykalman_gives_the_same_with_offsets_and_missing_numbers():
    pykalman = pytest.importorskip("pykalman")
    kf = pykalman.KalmanFilter(
        transition_matrices=F,
        observation_matrices=H,
        transition_covariance=Q,
        observation_covariance=R,
        transition_offsets=[0.1, -0.2],
        observation_offsets=[0.7],
        initial_state_mean=[0.5, -1.0],
    )
    z = np.ma.masked_array(Z, np.arange(60) % 7 == 3)
    means, covs = kf.filter(z)
    ours = filters.run(filters.from_pykalman(kf), z.filled(np.nan))
    close(ours.means, means)
    close(ours.covs, covs)
    smoothed, _ = kf.smooth(z)
    close(filters.smooth(filters.from_pykalman(kf), z.filled(np.nan)).means, smoothed)


def test_a_matrix_of_each_step_is_an_input_of_a_model():
    pykalman = pytest.importorskip("pykalman")
    price = 50.0 + Z.cumsum()
    measured = 1.4 * price + 3.0 + 0.1 * Z
    kf = pykalman.KalmanFilter(
        transition_matrices=np.eye(2),
        observation_matrices=np.column_stack([price, np.ones_like(price)])[:, None, :],
        transition_covariance=1e-4 * np.eye(2),
        observation_covariance=[[1.0]],
        initial_state_mean=[0.0, 0.0],
        initial_state_covariance=np.eye(2),
    )
    with pytest.raises(ValueError, match=r"what changes is an input of a model.*other_packages\.md"):
        filters.from_pykalman(kf)
    model = filters.StateSpaceModel(
        transition=lambda x, u, c: x,
        observe=lambda x, u, c: (x[0] * u[0] + x[1],),
        process_noise_cov=[1e-4, 1e-4],
        measurement_noise_cov=[1.0],
        prior_mean=[0.0, 0.0],
        prior_cov=[1.0 - 1e-4, 1.0 - 1e-4],
        inputs=1,
    )
    run = {"inputs": price, "measurements": measured, "update_first": False}
    close(filters.run(filters.make_filter("ekf", model), **run).means, kf.filter(measured)[0])
    close(filters.smooth(filters.make_filter("ekf", model), **run).means, kf.smooth(measured)[0])


def test_statsmodels_gives_the_same_states_and_likelihood():
    structural = pytest.importorskip("statsmodels.tsa.statespace.structural")
    model = structural.UnobservedComponents(Z, "lltrend")
    results = model.filter([0.3, 0.02, 0.05])
    ours = filters.run(filters.from_statsmodels(results), Z)
    scale = np.abs(results.filtered_state).max()
    np.testing.assert_allclose(ours.means, results.filtered_state.T, rtol=1e-9, atol=1e-9 * scale)
    close(ours.log_likelihoods, results.filter_results.llf_obs)
    without_noise = pytest.importorskip("statsmodels.tsa.statespace.sarimax").SARIMAX(Z, order=(1, 0, 0))
    with pytest.raises(ValueError, match="measurement_error=True"):
        filters.from_statsmodels(without_noise.filter([0.5, 1.0]))


def test_a_continuous_system_is_sampled_and_its_gain_is_that_of_riccati():
    from scipy.linalg import expm, solve_discrete_are
    from scipy.signal import StateSpace, TransferFunction

    a, b, c = np.array([[0.0, 1.0], [-4.0, -0.4]]), np.array([[0.0], [1.0]]), np.array([[1.0, 0.0]])
    filter_ = filters.from_control(StateSpace(a, b, c, 0.0), [0.2], [0.3], dt=0.1, noise_input=b)
    f, g, _, h, _ = filter_.model.matrices()
    np.testing.assert_allclose(f, expm(0.1 * a), rtol=1e-12)
    np.testing.assert_allclose(g, np.linalg.solve(a, (f - np.eye(2)) @ b), rtol=1e-12)
    times = np.linspace(0.0, 0.1, 2001)
    flows = np.array([expm(a * t) @ b for t in times])[..., 0]
    q = 0.2 * np.trapezoid(flows[:, :, None] * flows[:, None, :], times, axis=0)
    np.testing.assert_allclose(filter_.model.process_noise_cov, q, rtol=1e-6)
    p = solve_discrete_are(f.T, h.T, filter_.model.process_noise_cov, [[0.3]])
    np.testing.assert_allclose(filter_.model.prior_cov, p, rtol=1e-8)
    sampled = StateSpace(f, g, h, 0.0, dt=0.1)
    again = filters.from_control(sampled, filter_.model.process_noise_cov, [0.3])
    np.testing.assert_allclose(again.model.numbers, filter_.model.numbers, rtol=1e-8)
    assert filters.from_control(TransferFunction([1.0], [1.0, 0.4, 4.0]), [0.0, 1.0], [0.3], dt=0.1).model.n == 2


def test_what_does_not_fit_is_refused():
    from scipy.signal import StateSpace

    class Fading:
        F, H, Q, R, x, P, alpha = F, H, Q, R, np.zeros(2), np.eye(2), 1.02

    with pytest.raises(ValueError, match="alpha = 1, but got 1.02"):
        filters.from_filterpy(Fading())
    with pytest.raises(ValueError, match="has no F"):
        filters.from_filterpy(3)
    kf = filterpy_filter(np.array([0.0, 0.5]))  # which FilterPy multiplies by u, too
    assert filters.from_filterpy(kf).model.matrices()[1].tolist() == [[0.0], [0.5]]
    kf.B = 0.5
    with pytest.raises(ValueError, match="must have shapes"):
        filters.from_filterpy(kf)
    for converter in (filters.from_pykalman, filters.from_statsmodels):
        with pytest.raises(ValueError, match="but got 3"):
            converter(3)
    with pytest.raises(ValueError, match="dt="):
        filters.from_control(StateSpace([[-1.0]], [[1.0]], [[1.0]], [[0.0]]), [1.0], [1.0])
    with pytest.raises(ValueError, match="D must be zero"):
        filters.from_control(StateSpace([[-1.0]], [[1.0]], [[1.0]], [[1.0]]), [1.0], [1.0], dt=0.1)
    resting = StateSpace(np.zeros((2, 2)), np.ones((2, 1)), [[1.0, 0.0]], 0.0)
    with pytest.raises(ValueError, match=r"\(prior_cov=\), but got none"):
        filters.from_control(resting, [1.0, 1.0], [1.0], dt=0.1)
    with pytest.raises(ValueError, match=r"noise_input must have shape \(n, w\) with n = 2, but got \(3, 1\)"):
        filters.from_control(resting, [1.0], [1.0], dt=0.1, noise_input=[1.0, 0.0, 0.0])
    with pytest.raises(ValueError, match="must be 'kf' of an affine model"):
        filters.to_filterpy(3)


def test_filterpy_is_smoothed_as_by_its_own_smoother():
    kf = filterpy_filter()
    means, covs, _, _ = kf.batch_filter(Z)
    smoothed, smoothed_covs, _, _ = kf.rts_smoother(means, covs)
    kf = filterpy_filter()
    ours = filters.smooth(filters.from_filterpy(kf), Z)
    close(ours.means, smoothed[..., 0])
    close(ours.covs, smoothed_covs)
    started = filters.from_filterpy(filterpy_filter(np.array([[0.3], [0.5]])), first_input=[1.0])
    assert filters.smooth(started, inputs=np.ones(59), measurements=Z, lag=2).means.shape == (60, 2)
