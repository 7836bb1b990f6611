"""The iterated extended filter against Gauss and Newton's method, the extended filter, the most probable state."""

import math

import numpy as np
import pytest
from scipy.optimize import minimize

from filters import (
    ExtendedKalmanFilter,
    IteratedExtendedKalmanFilter,
)
from tests.models import state_space

KEYS = np.zeros((1, 2))

pytestmark = pytest.mark.usefixtures("as_python")


def stay(x, u, c):
    return (x[0], x[1])


def look(x, c):
    return (math.sqrt(x[0] * x[0] + x[1] * x[1]), math.atan2(x[1], x[0]))


def look_jacobian(x, c):
    square = x[0] * x[0] + x[1] * x[1]
    distance = math.sqrt(square)
    return ((x[0] / distance, x[1] / distance), (-x[1] / square, x[0] / square))


def landmark(**changes):
    """A place in the plane, seen by distance and bearing."""
    noise = {"q": [0.01, 0.01], "r": [[0.05, 0.01], [0.01, 0.02]]}
    prior = {"mean": [3.0, 2.0], "cov": [[2.0, 0.4], [0.4, 1.0]]}
    return state_space(stay, look, **noise, **prior, **{"observe_jacobian": look_jacobian, **changes})


@pytest.mark.parametrize("iterations", [1, 2, 4])
def test_an_update_is_that_many_steps_of_gauss_and_newton(iterations):
    model, z = landmark(), np.array([2.5, 0.9])
    updated, innovation = IteratedExtendedKalmanFilter(model=model, iterations=iterations).update(
        ExtendedKalmanFilter(model=model).init(), z
    )
    mean, p, r = model.prior_mean, model.prior_cov, model.measurement_noise_cov
    weight_p, weight_r = np.linalg.inv(p), np.linalg.inv(r)
    x = mean
    for _ in range(iterations):  # on the squares of both misfits, each in its own metric
        h = np.array(look_jacobian(x, ()))
        slope = h.T @ weight_r @ (z - look(x, ())) + weight_p @ (mean - x)
        x = x + np.linalg.solve(weight_p + h.T @ weight_r @ h, slope)
    np.testing.assert_allclose(updated.mean, x, rtol=1e-10)
    np.testing.assert_allclose(updated.cov, np.linalg.inv(weight_p + h.T @ weight_r @ h), rtol=1e-10)
    first = np.array(look_jacobian(mean, ()))
    np.testing.assert_allclose(innovation.value, z - look(mean, ()), rtol=1e-12)
    np.testing.assert_allclose(innovation.cov, first @ p @ first.T + r, rtol=1e-12)


def test_many_iterations_find_the_most_probable_state():
    model, z = landmark(), np.array([2.0, 1.2])
    weight_p, weight_r = np.linalg.inv(model.prior_cov), np.linalg.inv(model.measurement_noise_cov)

    def misfit(x):
        e, d = z - look(x, ()), x - model.prior_mean
        return e @ weight_r @ e + d @ weight_p @ d

    best = minimize(misfit, model.prior_mean, tol=1e-14).x
    filter_ = IteratedExtendedKalmanFilter(model=model, iterations=20)
    found, _ = filter_.update(filter_.init(), z)
    np.testing.assert_allclose(found.mean, best, rtol=1e-6)
    once, _ = ExtendedKalmanFilter(model=model).update(filter_.init(), z)
    assert misfit(found.mean) < 0.9 * misfit(once.mean)


def test_a_missing_channel_of_a_nonlinear_measurement_has_no_effect():
    both = landmark()
    one = landmark(
        observe=lambda x, c: (look(x, c)[0],),
        observe_jacobian=lambda x, c: (look_jacobian(x, c)[0],),
        measurement_noise_cov=[0.05],
    )
    found, innovation = IteratedExtendedKalmanFilter(model=both).update(
        IteratedExtendedKalmanFilter(model=both).init(), [2.5, np.nan]
    )
    expected, alone = IteratedExtendedKalmanFilter(model=one).update(
        IteratedExtendedKalmanFilter(model=one).init(), [2.5]
    )
    np.testing.assert_allclose(found.mean, expected.mean, rtol=1e-12)
    np.testing.assert_allclose(found.cov, expected.cov, rtol=1e-12)
    assert innovation.value[1] == 0.0
    assert innovation.log_likelihood == pytest.approx(alone.log_likelihood, rel=1e-12)
