"""The iterated ensemble Kalman filter: an N x N textbook form, its first iteration, and where the last ends."""

import numpy as np
import pytest
from scipy.linalg import inv, sqrtm
from scipy.optimize import minimize_scalar

from filters import EnsembleTransformFilter, IteratedEnsembleKalmanFilter
from tests.models import KEY, plane_model, state_space
from thruster_env.core.compiled import interpreted

SIZE = 9


def stay(x, u, c):
    return x


def curved(x, c):
    return (x[0] + 0.2 * x[1] * x[1], x[0] * x[1])


def curved_model(**changes):
    prior = {"mean": [1.0, -0.5], "cov": [[0.8, 0.2], [0.2, 0.5]]}
    return state_space(stay, curved, q=[0.1, 0.1], r=[[0.5, 0.2], [0.2, 0.3]], **prior, **{"inputs": 0, **changes})


def updated(kind, model, z, **numbers):
    """Forecast and analysis of one update."""
    filter_ = kind(model=model, **{"ensemble_size": SIZE, **numbers})
    with interpreted():
        forecast = filter_.predict(filter_.init(KEY), np.zeros(model.inputs))
        return (forecast, *filter_.update(forecast, z))


def naive_iterations(x, observe, z, r, iterations):
    """Members after Gauss-Newton steps in the space of weights, everything N x N."""
    n_1, size = x.shape[1] - 1, x.shape[1]
    mean = x.mean(axis=1, keepdims=True)
    far, inverse = x - mean, inv(r)
    w, transform = np.zeros(size), np.eye(size)
    for _ in range(iterations):
        members = mean + (far @ w)[:, None] + far @ transform
        y = np.array([observe(tuple(member), ()) for member in members.T]).T
        slopes = (y - y.mean(axis=1, keepdims=True)) @ inv(transform)
        hessian = n_1 * np.eye(size) + slopes.T @ inverse @ slopes
        w = w - inv(hessian) @ (n_1 * w - slopes.T @ inverse @ (z - y.mean(axis=1)))
        transform = sqrtm(n_1 * inv(hessian)).real
    return mean + (far @ w)[:, None] + far @ transform


@pytest.mark.parametrize("iterations", [1, 2, 3, 7])
def test_an_update_is_the_textbook_s(iterations):
    model, z = curved_model(), np.array([1.9, -1.4])
    forecast, analysis, _ = updated(IteratedEnsembleKalmanFilter, model, z, iterations=iterations)
    expected = naive_iterations(forecast.members, curved, z, model.measurement_noise_cov, iterations)
    np.testing.assert_allclose(analysis.members, expected, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(analysis.mean, expected.mean(axis=1), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(analysis.cov, np.cov(expected), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("channel", [0, 1])
def test_a_missing_channel_is_left_out_of_every_iteration(channel):
    model, z = curved_model(), np.array([np.nan, np.nan])
    z[channel] = 1.5
    forecast, analysis, _ = updated(IteratedEnsembleKalmanFilter, model, z, iterations=4)

    def observe(x, c):
        return (curved(x, c)[channel],)

    r = model.measurement_noise_cov[[channel], [channel]][:, None]
    expected = naive_iterations(forecast.members, observe, z[[channel]], r, 4)
    np.testing.assert_allclose(analysis.members, expected, rtol=1e-9, atol=1e-9)


def test_its_first_iteration_is_the_transform_filter_with_its_innovation():
    model, z = curved_model(), [1.9, -1.4]
    _, first, innovation = updated(IteratedEnsembleKalmanFilter, model, z, iterations=1)
    _, third, same = updated(IteratedEnsembleKalmanFilter, model, z, iterations=3)
    _, by_transform, of_transform = updated(EnsembleTransformFilter, model, z)
    np.testing.assert_allclose(first.members, by_transform.members, rtol=1e-13)
    assert not np.allclose(third.members, first.members, rtol=1e-3)
    for other in (same, of_transform):
        np.testing.assert_allclose(np.ravel(innovation.cov), np.ravel(other.cov), rtol=1e-13)
        np.testing.assert_allclose(innovation.value, other.value, rtol=1e-13)
        assert innovation.log_likelihood == pytest.approx(other.log_likelihood, rel=1e-13)


def test_where_measurements_are_linear_further_iterations_change_nothing():
    model = plane_model(b=np.zeros((2, 0)))
    _, once, _ = updated(IteratedEnsembleKalmanFilter, model, [2.0, -1.0], iterations=1)
    _, often, _ = updated(IteratedEnsembleKalmanFilter, model, [2.0, -1.0], iterations=20)
    np.testing.assert_allclose(often.members, once.members, rtol=1e-10, atol=1e-10)


def test_iterations_end_at_the_most_probable_state():
    """After a good measurement the members lie close together: the slopes they give are derivatives."""

    def cubed(x, c):
        return (x[0] ** 3,)

    model = curved_model(
        observe=cubed, process_noise_cov=[0.0], measurement_noise_cov=1e-2, prior_mean=[1.0], prior_cov=[0.04]
    )
    z, numbers = 2.5, {"ensemble_size": 40}
    forecast, analysis, _ = updated(IteratedEnsembleKalmanFilter, model, [z], iterations=10, **numbers)
    _, by_transform, _ = updated(EnsembleTransformFilter, model, [z], **numbers)

    def loss(x):
        return (x - forecast.mean[0]) ** 2 / forecast.cov[0, 0] + (z - cubed((x,), ())[0]) ** 2 / 1e-2

    most_probable = minimize_scalar(loss, bounds=(0.5, 2.0), method="bounded", options={"xatol": 1e-9}).x
    spread = analysis.cov[0, 0] ** 0.5
    assert abs(analysis.mean[0] - most_probable) < 0.05 * spread
    assert abs(by_transform.mean[0] - most_probable) > 2.0 * spread


@pytest.mark.parametrize("iterations", [0, 1.5, float("nan"), "many", None])
def test_no_whole_number_of_iterations_is_refused(iterations):
    with pytest.raises(ValueError, match="iterations must be a (whole|finite) number.* but got"):
        IteratedEnsembleKalmanFilter(model=curved_model(), iterations=iterations)
