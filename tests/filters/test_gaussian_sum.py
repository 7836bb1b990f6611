"""The Gaussian sum filter: its split and merge, the naive one, the Kalman filter's case, and two modes."""

import math

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from filters import ExtendedKalmanFilter, GaussianSumFilter, KalmanFilter, run
from tests.models import line_model, simulated, state_space
from thruster_env.core.compiled import interpreted

KEYS = np.zeros((1, 2))


def stay(x, u, c):
    return (0.9 * x[0] + 0.1 * x[1], x[1])


def square(x, c):
    return (x[1] * x[1] + 0.1 * x[0], x[0])


def square_model(mean=0.2):
    return state_space(
        stay, square, q=[0.1, 0.2], r=[[0.05, 0.01], [0.01, 0.5]], mean=[0.5, mean], cov=[[0.5, 0.2], [0.2, 1.0]]
    )


@pytest.mark.parametrize("parts", [7, 15, 40])
def test_the_standard_split_has_mean_zero_and_variance_one(parts):
    nodes, weights, variance = GaussianSumFilter(model=line_model(), parts=parts).standard_split
    assert len(nodes) == len(weights) == parts
    assert 0.0 < variance < 1.0 and (weights > 0.0).all()
    moments = weights.sum(), weights @ nodes, weights @ nodes**2 + variance
    assert moments == pytest.approx((1.0, 0.0, 1.0), abs=1e-14)


@pytest.mark.parametrize("component", [0, 1])
def test_an_update_is_the_naive_one(component):
    model = square_model()
    filter_ = GaussianSumFilter(model=model, parts=9, component=component)
    z, r = np.array([2.0, 0.3]), model.measurement_noise_cov
    with interpreted():
        belief = filter_.init()
        updated, innovation = filter_.update(belief, z)
    nodes, weights, variance = filter_.standard_split
    g = belief.cov[:, component] / math.sqrt(belief.cov[component, component])
    p = belief.cov - (1.0 - variance) * np.outer(g, g)
    means, covs, likelihoods, seen, spreads = [], [], [], [], []
    for node in nodes:
        x = belief.mean + node * g
        h = np.array([[0.1, 2.0 * x[1]], [1.0, 0.0]])
        y, s = np.array(square(x, ())), h @ p @ h.T + r
        gain = p @ h.T @ np.linalg.inv(s)
        means.append(x + gain @ (z - y))
        covs.append(p - gain @ s @ gain.T)
        likelihoods.append(multivariate_normal.pdf(z, y, s))
        seen.append(y)
        spreads.append(s)
    before = np.dot(weights, seen)
    apart = np.array(seen) - before
    s = np.einsum("k,kij->ij", weights, spreads + apart[:, :, None] * apart[:, None, :])
    np.testing.assert_allclose(innovation.value, z - before, rtol=1e-9)
    np.testing.assert_allclose(innovation.cov, s, rtol=1e-6)
    assert innovation.log_likelihood == pytest.approx(math.log(weights @ likelihoods), rel=1e-6)
    weights = weights * likelihoods / (weights @ likelihoods)
    mean = weights @ means
    apart = np.array(means) - mean
    cov = np.einsum("k,kij->ij", weights, covs + apart[:, :, None] * apart[:, None, :])
    np.testing.assert_allclose(updated.mean, mean, rtol=1e-6)
    np.testing.assert_allclose(updated.cov, cov, rtol=1e-6)
    for found, expected in zip(filter_.part_estimates(updated), (means, covs, weights), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-7)


def test_on_an_affine_model_it_is_nearly_the_kalman_filter():
    model = line_model()
    inputs, z = simulated(model, 60, level=1.0)
    z[0, 10:15] = np.nan
    with interpreted():
        exact = run(KalmanFilter(model=model), KEYS, inputs, z)
        found = run(GaussianSumFilter(model=model), KEYS, inputs, z)
    spread = np.sqrt(np.einsum("bkii->bki", exact.covs))
    assert np.abs((found.means - exact.means) / spread).max() < 0.005
    np.testing.assert_allclose(found.innovation_covs, exact.innovation_covs, rtol=0.005)
    np.testing.assert_allclose(found.log_likelihoods, exact.log_likelihoods, atol=0.005)


def test_it_sees_both_roots_of_a_measurement():
    filter_ = GaussianSumFilter(model=square_model(mean=0.0), parts=15)
    with interpreted():
        belief, _ = filter_.update(filter_.init(), [1.44, np.nan])
        extended = ExtendedKalmanFilter(model=filter_.model)
        tangent, _ = extended.update(extended.init(), [1.44, np.nan])
    means, _, weights = filter_.part_estimates(belief)
    assert weights[means[:, 1] > 1.0].sum() > 0.4 and weights[means[:, 1] < -1.0].sum() > 0.4
    assert abs(belief.mean[1]) < 0.1 and belief.cov[1, 1] == pytest.approx(1.44, rel=0.1)
    assert abs(tangent.mean[1]) < 0.6 and tangent.cov[1, 1] > 0.8  # the flat tangent knows nothing of them


def test_a_component_that_is_known_is_not_split():
    model = line_model().replace(prior_cov=[[1.0, 0.0], [0.0, 0.0]])
    with interpreted():
        exact, _ = KalmanFilter(model=model).update(KalmanFilter(model=model).init(), [2.0])
        found, _ = GaussianSumFilter(model=model).update(GaussianSumFilter(model=model).init(), [2.0])
    np.testing.assert_allclose(found.mean, exact.mean, rtol=1e-12)
    np.testing.assert_allclose(found.cov, exact.cov, rtol=1e-12, atol=1e-15)
