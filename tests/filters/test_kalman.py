"""The Kalman filter against a textbook one, FilterPy, Riccati's equation and its operating point."""

import math

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from filters import ExtendedKalmanFilter, KalmanFilter, linearize, run, thruster_model
from tests.models import held_voltages, random_affine, simulated
from tests.oracles import each_equal, kalman_update
from thruster_env.core.streams import episode_keys
from thruster_env.model import simulate

KEYS = np.zeros((1, 2))

pytestmark = pytest.mark.usefixtures("as_python")


def textbook(model, inputs, measurements):
    """Kalman (1960) as in any book: x, P, innovations and S after every measurement."""
    a, b, offset, c, shift = model.matrices()
    x, p = model.prior_mean, model.prior_cov
    found = []
    for k, z in enumerate(measurements):
        if k > 0:
            x = a @ x + b @ inputs[k - 1] + offset
            p = a @ p @ a.T + model.process_noise_cov
        innovation = z - (c @ x + shift)
        x, p, s = kalman_update(x, p, innovation, c, model.measurement_noise_cov)
        found.append((x, p, innovation, s))
    return [np.array(part) for part in zip(*found, strict=True)]


@pytest.mark.parametrize("seed", range(3))
def test_it_is_the_textbook_filter(seed):
    model = random_affine(seed=seed)
    inputs, measurements = simulated(model, 200)
    estimates = run(KalmanFilter(model=model), KEYS, inputs, measurements)
    expected = textbook(model, inputs[0], measurements[0])
    for found, part in zip(estimates[:4], expected, strict=True):
        np.testing.assert_allclose(found[0], part, rtol=1e-10, atol=1e-10)


def test_it_is_filterpy_s_kalman_filter():
    peer = pytest.importorskip("filterpy.kalman")
    model = random_affine(seed=5)
    a, b, offset, c, shift = model.matrices()
    inputs, measurements = simulated(model, 200)
    estimates = run(KalmanFilter(model=model), KEYS, inputs, measurements)

    other = peer.KalmanFilter(dim_x=3, dim_z=2, dim_u=3)
    other.F, other.B, other.H = a, np.column_stack([b, offset]), c  # the offset as an input that is always 1
    other.Q, other.R = model.process_noise_cov, model.measurement_noise_cov
    other.x, other.P = model.prior_mean.reshape(3, 1), model.prior_cov
    for k, z in enumerate(measurements[0]):
        if k > 0:
            other.predict(u=np.append(inputs[0, k - 1], 1.0).reshape(3, 1))
        other.update((z - shift).reshape(2, 1))
        np.testing.assert_allclose(estimates.means[0, k], other.x[:, 0], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(estimates.covs[0, k], other.P, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(estimates.innovations[0, k], other.y[:, 0], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(estimates.innovation_covs[0, k], other.S, rtol=1e-9, atol=1e-9)


def test_the_extended_filter_is_filterpy_s_on_the_thruster():
    peer = pytest.importorskip("filterpy.kalman")
    model = thruster_model()
    inputs = held_voltages(1, 8, seed=3)
    drawn = simulate.simulate(model, episode_keys([3]), inputs)
    estimates = run(ExtendedKalmanFilter(model=model), KEYS, inputs, drawn.measurements)
    constants = model.constants

    def advance(x, u):
        """The state after one step, and the Jacobian of the whole step by the chain rule."""
        x, chain = tuple(x), np.eye(2)
        for _ in range(model.substeps):
            chain = np.array(model.transition_jacobian(x, u, constants)) @ chain
            x = model.transition(x, u, constants)
        return np.array(x), chain

    class Extended(peer.ExtendedKalmanFilter):
        def predict_x(self, u):
            x, self.F = advance(self.x[:, 0], tuple(u))
            self.x = x.reshape(2, 1)

    other = Extended(dim_x=2, dim_z=1)
    other.Q, other.R = model.process_noise_cov, model.measurement_noise_cov
    other.x, other.P = model.prior_mean.reshape(2, 1), model.prior_cov
    for k, z in enumerate(drawn.measurements[0]):
        if k > 0:
            other.predict(u=inputs[0, k - 1])
        other.update(
            z.reshape(1, 1),
            lambda x: np.array(model.observe_jacobian(tuple(x[:, 0]), constants)),
            lambda x: np.array(model.observe(tuple(x[:, 0]), constants)).reshape(1, 1),
        )
        np.testing.assert_allclose(estimates.means[0, k], other.x[:, 0], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(estimates.covs[0, k], other.P, rtol=1e-9, atol=1e-9)


def test_its_steady_covariance_solves_riccati_s_equation():
    model = random_affine(seed=2)
    (a, _, _, c, _), r = model.matrices(), model.measurement_noise_cov
    predicted = solve_discrete_are(a.T, c.T, model.process_noise_cov, r)
    updated = predicted - predicted @ c.T @ np.linalg.inv(c @ predicted @ c.T + r) @ c @ predicted
    estimates = run(KalmanFilter(model=model), KEYS, np.zeros((1, 200, 2)), np.zeros((1, 201, 2)))
    np.testing.assert_allclose(estimates.covs[0, -1], updated, rtol=1e-9)
    np.testing.assert_allclose(estimates.innovation_covs[0, -1], c @ predicted @ c.T + r, rtol=1e-9)


def test_its_errors_are_as_large_as_it_says():
    model = random_affine(seed=4)
    inputs = np.zeros((100, 20, 2))
    drawn = simulate.simulate(model, episode_keys(range(100)), inputs)
    estimates = run(KalmanFilter(model=model), np.zeros((100, 2)), inputs, drawn.measurements)
    errors = drawn.states[:, -1] - estimates.means[:, -1]
    nees = np.einsum("bi,bij,bj->b", errors, np.linalg.inv(estimates.covs[:, -1]), errors)
    assert abs(nees.mean() - 3.0) < 3 * nees.std() / math.sqrt(100)  # 3 states, three standard errors
    v = estimates.innovations[:, -1]
    nis = np.einsum("bi,bij,bj->b", v, np.linalg.inv(estimates.innovation_covs[:, -1]), v)
    assert abs(nis.mean() - 2.0) < 3 * nis.std() / math.sqrt(100)


@pytest.mark.parametrize("voltage", [None, -6.0])
def test_on_the_thruster_it_is_the_affine_filter_about_the_operating_point(voltage):
    model = thruster_model(operating_voltage=voltage)
    x, u = model.operating_state, model.operating_input
    assert u[0] == (12.0 if voltage is None else voltage)  # half of max_voltage
    inputs, measurements = simulated(model, 50, level=6.0)
    of_nonlinear = run(KalmanFilter(model=model), KEYS, inputs, measurements)
    of_affine = run(KalmanFilter(model=linearize(model, x, u)), KEYS, inputs, measurements)
    each_equal(of_nonlinear, of_affine)


def test_linearize_keeps_the_offsets_and_has_the_slopes_of_the_whole_step():
    model = thruster_model()
    assert model.substeps > 1
    x, u = np.array([60.0, 0.7]), np.array([9.0])  # no steady state: f(x, u) is not x

    def f(x, u):
        x = tuple(x)
        for _ in range(model.substeps):
            x = model.transition(x, tuple(u), model.constants)
        return np.array(x)

    def h(x):
        return np.array(model.observe(tuple(x), model.constants))

    def slope(function, at, i):
        step = np.zeros(len(at))
        step[i] = 1e-5
        return (function(at + step) - function(at - step)) / 2e-5

    affine = linearize(model, x, u)
    a, b, offset, c, shift = affine.matrices()
    np.testing.assert_allclose(a @ x + b @ u + offset, f(x, u), rtol=1e-12)
    np.testing.assert_allclose(c @ x + shift, h(x), rtol=1e-12)
    for i in range(2):
        np.testing.assert_allclose(a[:, i], slope(lambda y: f(y, u), x, i), rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(c[:, i], slope(h, x, i), rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(b[:, 0], slope(lambda v: f(x, v), u, 0), rtol=1e-6, atol=1e-9)
    for name in ("process_noise_cov", "measurement_noise_cov", "prior_mean", "prior_cov"):
        np.testing.assert_array_equal(getattr(affine, name), getattr(model, name))


def test_an_affine_model_is_its_own_linearisation():
    model = random_affine()
    assert linearize(model, np.ones(3), np.ones(2)) is model


def test_a_nonlinear_model_without_an_operating_point_is_refused():
    model = thruster_model().replace(operating_input=None)
    with pytest.raises(ValueError, match="operating state and input.*operating_input=None"):
        KalmanFilter(model=model)


def test_a_state_known_exactly_at_first_stays_known_through_the_first_measurement():
    model = random_affine()
    model = model.replace(prior_cov=np.zeros((3, 3)))
    inputs, measurements = simulated(model, 20)
    estimates = run(KalmanFilter(model=model), KEYS, inputs, measurements)
    np.testing.assert_array_equal(estimates.means[0, 0], model.prior_mean)
    np.testing.assert_array_equal(estimates.covs[0, 0], np.zeros((3, 3)))
    expected = textbook(model, inputs[0], measurements[0])
    np.testing.assert_allclose(estimates.means[0], expected[0], rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("r", [0.0, [[0.0]]])
def test_measurements_without_noise_are_refused_in_one_line(r):
    with pytest.raises(ValueError, match="measurement_noise_cov must be positive definite, but got") as error:
        thruster_model(measurement_noise_cov=r)
    assert "\n" not in str(error.value)
