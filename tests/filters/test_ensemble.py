"""The ensemble Kalman filter against the Kalman filter and a naive analysis, and the noise it adds."""

import math

import numpy as np
import pytest

from filters import EnsembleKalmanFilter, ExtendedKalmanFilter, KalmanFilter, run, thruster_model
from tests.models import KEY, held_voltages, line_model, plane_model, simulated
from tests.oracles import assert_normal, convergence, normals, relative_errors
from thruster_env.core.compiled import interpreted
from thruster_env.core.streams import FILTER_MEASUREMENT, FILTER_PRIOR, FILTER_PROCESS, episode_keys, filter_keys
from thruster_env.model import simulate


@pytest.mark.parametrize("centred", [0, 1])
def test_one_cycle_is_the_naive_one_with_the_same_normals(centred):
    size, model = 11, plane_model()
    a, b, offset, c, shift = model.matrices()
    filter_ = EnsembleKalmanFilter(model=model, ensemble_size=size, centred_perturbations=centred)
    root_p, root_q, root_r = (
        np.linalg.cholesky(cov) for cov in (model.prior_cov, model.process_noise_cov, model.measurement_noise_cov)
    )
    with interpreted():
        belief = filter_.init(KEY)
        x = model.prior_mean[:, None] + root_p @ normals(FILTER_PRIOR, 0, 2, size)
        np.testing.assert_allclose(belief.members, x, rtol=1e-12, atol=1e-12)
        for step, (u, z) in enumerate([(0.5, [2.0, -1.0]), (-1.0, [0.3, 0.9])], start=1):
            belief = filter_.predict(belief, [u])
            x = a @ x + b * u + offset[:, None] + root_q @ normals(FILTER_PROCESS, step, 2, size)
            np.testing.assert_allclose(belief.members, x, rtol=1e-12, atol=1e-12)
            np.testing.assert_allclose(belief.mean, x.mean(axis=1), rtol=1e-12, atol=1e-12)
            np.testing.assert_allclose(belief.cov, np.cov(x), rtol=1e-12, atol=1e-12)

            belief, innovation = filter_.update(belief, z)
            y = c @ x + shift[:, None]
            joint = np.cov(x, y)  # divisor size - 1
            s = joint[2:, 2:] + model.measurement_noise_cov
            gain = joint[:2, 2:] @ np.linalg.inv(s)
            v = root_r @ normals(FILTER_MEASUREMENT, step, 2, size)
            if centred:  # the sample of v has mean zero, and covariance R on average over draws
                v = (v - v.mean(axis=1, keepdims=True)) * math.sqrt(size / (size - 1))
            x = x + gain @ (np.array(z)[:, None] - v - y)
            np.testing.assert_allclose(belief.members, x, rtol=1e-12, atol=1e-12)
            np.testing.assert_allclose(belief.mean, x.mean(axis=1), rtol=1e-12, atol=1e-12)
            np.testing.assert_allclose(belief.cov, np.cov(x), rtol=1e-12, atol=1e-12)
            np.testing.assert_allclose(innovation.value, z - y.mean(axis=1), rtol=1e-12, atol=1e-12)
            np.testing.assert_allclose(innovation.cov, s, rtol=1e-12, atol=1e-12)


def test_centred_perturbations_move_the_mean_as_the_gain_says():
    model, z = plane_model(), [2.0, -1.0]
    filter_ = EnsembleKalmanFilter(model=model, ensemble_size=5, centred_perturbations=1)
    with interpreted():
        prior = filter_.init(KEY)
        belief, innovation = filter_.update(prior, z)
    _, _, _, c, _ = model.matrices()
    gain = prior.cov @ c.T @ np.linalg.inv(innovation.cov)
    np.testing.assert_allclose(belief.mean, prior.mean + gain @ innovation.value, rtol=1e-12)
    with pytest.raises(ValueError, match="centred_perturbations must be 0 or 1, but got 2"):
        EnsembleKalmanFilter(model=model, centred_perturbations=2)


def test_members_are_stirred_by_the_prior_the_process_noise_and_the_measurement_noise():
    model, size = plane_model(), 2000
    a, b, offset, c, shift = model.matrices()
    filter_ = EnsembleKalmanFilter(model=model, ensemble_size=size)
    z = np.array([1.0, 2.0])
    with interpreted():
        first = filter_.init(KEY)
        second = filter_.predict(first, [0.5])
        third = filter_.predict(second, [0.5])
        updated, innovation = filter_.update(third, z)
    drift = (offset + b[:, 0] * 0.5)[:, None]
    w_1 = second.members - a @ first.members - drift
    w_2 = third.members - a @ second.members - drift
    # The analysis solved for the noise that each member took the measurement with.
    gain = np.cov(third.members) @ c.T @ np.linalg.inv(innovation.cov)
    expected = c @ third.members + shift[:, None]
    v = z[:, None] - expected - np.linalg.inv(gain) @ (updated.members - third.members)
    assert_normal(first.members, model.prior_cov, model.prior_mean)
    assert_normal(w_1, model.process_noise_cov)
    assert_normal(w_2, model.process_noise_cov)
    assert_normal(v, model.measurement_noise_cov)
    # Nothing that stirs the members is correlated with anything else.
    together = np.corrcoef(np.vstack([first.members, w_1, w_2, v]))
    for i in range(0, 8, 2):
        together[i : i + 2, i : i + 2] = 0.0
    assert np.abs(together).max() < 4 / math.sqrt(size)


def test_it_converges_to_the_kalman_filter_like_one_over_root_n():
    model = line_model()
    inputs, measurements = simulated(model, 30, count=60, seed=0, level=1.0, compiled=True)
    data = filter_keys(range(60)), inputs, measurements
    exact, sizes = run(KalmanFilter(model=model), *data), [20, 80, 320, 1280]
    errors, found = convergence(
        lambda size: EnsembleKalmanFilter(model=model, ensemble_size=size), sizes, data, exact.means, exact.covs
    )
    for slope in np.polyfit(np.log(sizes), np.log(errors.T), 1)[0]:
        assert -0.6 < slope < -0.4  # 60 independent runs give each error to about 6 %, the slope to 0.03
    # Averaged over the runs nothing remains but the bias of order 1/N: four standard errors of 1/sqrt(60 N).
    bias = relative_errors(found, exact.means, exact.covs)[0][:, -1].mean(axis=0)
    assert (np.abs(bias) < 4 * errors[0, -1] / math.sqrt(60)).all()


def test_on_the_thruster_a_hundred_members_are_as_good_as_the_extended_filter():
    model = thruster_model(process_noise_cov=[1.0, 4e-4], measurement_noise_cov=0.25)
    inputs = held_voltages(100, 20)
    drawn = simulate.simulate(model, episode_keys(range(100)), inputs)

    def rmse(filter_):
        estimates = run(filter_, filter_keys(range(100)), inputs, drawn.measurements)
        assert (estimates.divergences == 0).all()
        return np.sqrt(np.mean((estimates.means - drawn.states)[:, 50:] ** 2, axis=(0, 1)))

    ensemble = rmse(EnsembleKalmanFilter(model=model, ensemble_size=100))
    np.testing.assert_allclose(ensemble, rmse(ExtendedKalmanFilter(model=model)), rtol=0.05)


@pytest.mark.parametrize("size", [1, 0, -3, 2.5, math.nan, "many", None])
def test_fewer_than_two_members_or_no_whole_number_is_refused(size):
    with pytest.raises(ValueError, match="ensemble_size must be a (whole|finite) number.* but got"):
        EnsembleKalmanFilter(model=line_model(), ensemble_size=size)


def test_two_members_are_enough_to_run():
    filter_ = EnsembleKalmanFilter(model=line_model(), ensemble_size=2)
    with interpreted():
        estimates = run(filter_, np.array([KEY]), np.zeros((1, 20, 1)), np.zeros((1, 21, 1)))
    assert np.isfinite(estimates.means).all()
    assert estimates.divergences.tolist() == [0]
