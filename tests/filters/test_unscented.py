"""Unscented and cubature filters against the textbook's weighted sums, FilterPy and the Kalman filter."""

import numpy as np
import pytest

from filters import CubatureKalmanFilter, UnscentedKalmanFilter, run, thruster_model
from tests.models import pendulum, simulated

KEYS = np.zeros((1, 2))
NUMBERS = [(1.0, 2.0, 0.0), (0.1, 2.0, 1.0), (0.5, 0.0, 0.0), (1.3, 1.0, 2.0)]  # alpha, beta, kappa

pytestmark = pytest.mark.usefixtures("as_python")


def scaled_weights(n, alpha, beta, kappa):
    """Weights for mean and covariance and the factor of P, as in Wan and van der Merwe."""
    surplus = alpha**2 * (n + kappa) - n  # lambda
    mean = np.full(2 * n + 1, 1 / (2 * (n + surplus)))
    cov = mean.copy()
    mean[0] = surplus / (n + surplus)
    cov[0] = mean[0] + 1 - alpha**2 + beta
    return mean, cov, n + surplus


def cubature_weights(n):
    """The same for the points of Arasaratnam and Haykin, with a centre that weighs nothing."""
    weights = np.append(0.0, np.full(2 * n, 1 / (2 * n)))
    return weights, weights, n


def textbook(model, weights, inputs, measurements):
    """The filter by weighted sums over sigma points, negative weights and all, with P - K S K'."""
    mean_weights, cov_weights, factor = weights
    x, p, c = model.prior_mean, model.prior_cov, model.constants

    def points():
        root = np.linalg.cholesky(factor * p)
        return np.vstack([x, x + root.T, x - root.T])

    def moments(values):
        mean = mean_weights @ values
        return mean, values - mean

    found = []
    for k, z in enumerate(measurements):
        if k > 0:
            moved = points()
            for _ in range(model.substeps):
                moved = np.array([model.transition(tuple(point), tuple(inputs[k - 1]), c) for point in moved])
            x, d = moments(moved)
            p = (cov_weights * d.T) @ d + model.process_noise_cov
        drawn = points()
        z_mean, e = moments(np.array([model.observe(tuple(point), c) for point in drawn]))
        s = (cov_weights * e.T) @ e + model.measurement_noise_cov
        gain = (cov_weights * (drawn - x).T) @ e @ np.linalg.inv(s)
        innovation = z - z_mean
        x, p = x + gain @ innovation, p - gain @ s @ gain.T
        found.append((x, p, innovation, s))
    return [np.array(part) for part in zip(*found, strict=True)]


def assert_textbook(filter_, weights, rtol=1e-9):
    model = filter_.model
    inputs, measurements = simulated(model)
    estimates = run(filter_, KEYS, inputs, measurements)
    expected = textbook(model, weights, inputs[0], measurements[0])
    for found, part in zip(estimates[:4], expected, strict=True):
        np.testing.assert_allclose(found[0], part, rtol=rtol, atol=1e-9)


@pytest.mark.parametrize("numbers", NUMBERS)
@pytest.mark.parametrize("model", [pendulum(), pendulum(substeps=3), thruster_model()], ids=["1", "3", "thruster"])
def test_it_is_the_textbook_s_unscented_filter(model, numbers):
    alpha, beta, kappa = numbers
    filter_ = UnscentedKalmanFilter(model=model, alpha=alpha, beta=beta, kappa=kappa)
    assert_textbook(filter_, scaled_weights(2, *numbers))


@pytest.mark.parametrize("model", [pendulum(), pendulum(substeps=3), thruster_model()], ids=["1", "3", "thruster"])
def test_it_is_the_textbook_s_cubature_filter(model):
    assert_textbook(CubatureKalmanFilter(model=model), cubature_weights(2))


def test_states_that_are_known_exactly_move_no_measurement():
    model = thruster_model(process_noise_cov=[0.0, 0.0]).replace(prior_cov=[0.0, 0.0])
    inputs = np.full((1, 50, 1), 9.0)
    for kind in (UnscentedKalmanFilter, CubatureKalmanFilter):
        estimates = run(kind(model=model), KEYS, inputs, np.full((1, 51, 1), 3.0))
        np.testing.assert_array_equal(estimates.covs, np.zeros((1, 51, 2, 2)))
        x = tuple(model.prior_mean)
        for _ in range(50 * model.substeps):
            x = model.transition(x, (9.0,), model.constants)
        np.testing.assert_allclose(estimates.means[0, -1], x, rtol=1e-12)


def bend(x, u, c):
    return (3.0 * x[0] * x[0], x[1] - x[0] * x[0])


@pytest.mark.parametrize("numbers", [(1.0, 0.0, 0.0), (0.01, 0.0, 0.0), (0.5, 2.0, -1.5), (3.0, 9.0, -1.9)])
def test_covariances_stay_positive_where_the_centre_weighs_less_than_nothing(numbers):
    alpha, beta, kappa = numbers
    assert scaled_weights(2, *numbers)[0][0] <= 0
    model = pendulum(transition=bend, process_noise_cov=[1e-6, 1e-6], prior_cov=[1.0, 1.0])
    filter_ = UnscentedKalmanFilter(model=model, alpha=alpha, beta=beta, kappa=kappa)
    belief = filter_.init()
    for z in ([0.3, -2.0], [1.0, 5.0], [-1.0, 0.0]):
        belief = filter_.predict(belief, [0.0])
        assert (belief.cov == belief.cov.T).all() and np.linalg.eigvalsh(belief.cov)[0] > 0
        belief, innovation = filter_.update(belief, z)
        assert (belief.cov == belief.cov.T).all() and np.linalg.eigvalsh(belief.cov)[0] > 0
        assert np.linalg.eigvalsh(innovation.cov)[0] > 0
