"""The steady-state filter against the Kalman filter, Riccati's equation and its own errors."""

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from filters import KalmanFilter, SteadyStateKalmanFilter, linearize, run, thruster_model
from filters.bounds import riccati_covariances
from tests.models import simulated, wide_model
from tests.oracles import each_close, each_equal

KEYS = np.zeros((1, 2))

pytestmark = pytest.mark.usefixtures("as_python")


def test_from_riccati_s_covariance_on_it_is_the_kalman_filter():
    model = wide_model()
    model = model.replace(prior_cov=riccati_covariances(model)[0])
    inputs, measurements = simulated(model)
    steady = run(SteadyStateKalmanFilter(model=model), KEYS, inputs, measurements)
    each_close(steady, run(KalmanFilter(model=model), KEYS, inputs, measurements), rtol=1e-10, atol=1e-10)


def test_its_gain_is_the_limit_of_the_kalman_filter_s():
    model = wide_model()
    a, _, _, c, _ = model.matrices()
    r, p = model.measurement_noise_cov, model.prior_cov
    for _ in range(200):
        gain = p @ c.T @ np.linalg.inv(c @ p @ c.T + r)
        p = a @ (p - gain @ c @ p) @ a.T + model.process_noise_cov
    np.testing.assert_allclose(SteadyStateKalmanFilter(model=model).gain, gain, rtol=1e-10)


def test_estimates_and_covariances_approach_the_kalman_filter_s():
    model = wide_model()
    inputs, measurements = simulated(model, 300)
    steady = run(SteadyStateKalmanFilter(model=model), KEYS, inputs, measurements)
    kalman = run(KalmanFilter(model=model), KEYS, inputs, measurements)
    assert np.abs(steady.means[0, 1] - kalman.means[0, 1]).max() > 1e-3
    for one, other in zip(steady[:5], kalman[:5], strict=True):
        np.testing.assert_allclose(one[0, -1], other[0, -1], rtol=1e-9, atol=1e-9)


def test_its_covariance_is_that_of_its_errors_from_the_prior_on_and_through_gaps():
    model = wide_model()
    a, b, offset, c, shift = model.matrices()
    filter_ = SteadyStateKalmanFilter(model=model)
    gain, q, r = filter_.gain, model.process_noise_cov, model.measurement_noise_cov
    inputs, z = simulated(model, 20)
    z[0, 5:9], z[0, 12, 1], z[0, 13, 0] = np.nan, np.nan, np.nan
    estimates = run(filter_, KEYS, inputs, z)
    x, p = model.prior_mean, model.prior_cov
    for k in range(21):
        if k > 0:
            x, p = a @ x + b @ inputs[0, k - 1] + offset, a @ p @ a.T + q
        there = ~np.isnan(z[0, k])
        used = gain[:, there]  # the columns of the channels that are there, as they are
        rest = np.eye(3) - used @ c[there]
        x = x + used @ (z[0, k] - c @ x - shift)[there]
        p = rest @ p @ rest.T + used @ r[np.ix_(there, there)] @ used.T
        np.testing.assert_allclose(estimates.means[0, k], x, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(estimates.covs[0, k], p, rtol=1e-10, atol=1e-10)


def test_on_the_thruster_it_is_the_filter_of_the_affine_approximation():
    model = thruster_model()
    affine = linearize(model, model.operating_state, model.operating_input)
    a, _, _, c, _ = affine.matrices()
    p = solve_discrete_are(a.T, c.T, model.process_noise_cov, model.measurement_noise_cov)
    filter_ = SteadyStateKalmanFilter(model=model)
    np.testing.assert_allclose(filter_.gain, p @ c.T / (c @ p @ c.T + model.measurement_noise_cov), rtol=1e-9)
    inputs, measurements = simulated(model, 50)
    of_affine = run(SteadyStateKalmanFilter(model=affine), KEYS, inputs, measurements)
    each_equal(run(filter_, KEYS, inputs, measurements), of_affine)


def test_a_state_known_exactly_at_first_is_allowed():
    model = wide_model(prior_cov=np.zeros((3, 3)))
    inputs, measurements = simulated(model)
    estimates = run(SteadyStateKalmanFilter(model=model), KEYS, inputs, measurements)
    assert np.isfinite(estimates.means).all()
    assert (np.linalg.eigvalsh(estimates.covs) > -1e-15).all()  # two measurements stir two of three directions
    assert (np.linalg.eigvalsh(estimates.covs[0, 1:]) > 0).all()


@pytest.mark.parametrize(
    "change",
    [
        {"a": np.diag([1.2, 0.5, 0.5]), "c": [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]},  # what grows is not seen
        {"a": np.diag([1.0, 0.5, 0.5]), "process_noise_cov": [0.0, 1.0, 1.0]},  # what lasts is not stirred
    ],
)
def test_a_model_without_a_steady_gain_is_refused_in_one_line(change):
    with pytest.raises(ValueError, match="Riccati's equation has a stabilising solution, but got A = ") as error:
        SteadyStateKalmanFilter(model=wide_model(**change))
    assert "\n" not in str(error.value)


def test_a_nonlinear_model_without_an_operating_point_is_refused():
    with pytest.raises(ValueError, match="operating state and input"):
        SteadyStateKalmanFilter(model=thruster_model().replace(operating_state=None))


def test_noise_of_single_steps_is_refused():
    filter_ = SteadyStateKalmanFilter(model=wide_model())
    with pytest.raises(ValueError, match="'kf-steady' cannot vary from step to step"):
        filter_.predict(filter_.init(), [0.0, 0.0], process_noise_cov=np.eye(3))
