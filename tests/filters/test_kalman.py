"""The Kalman filter, steady and scheduled too, against textbooks, FilterPy, Riccati and operating points."""

import math

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from filters import KalmanFilter, SteadyStateKalmanFilter, linearize, run, thruster_model
from filters.bounds import riccati_covariances
from tests.filters.checks import refused
from tests.models import held_voltages, random_affine, simulated, wide_model
from tests.oracles import each_close, each_equal, kalman_filter
from thruster_env.core.streams import episode_keys
from thruster_env.model import simulate
from thruster_env.thruster.analysis import steady_state
from thruster_env.thruster.plant import make_plant

KEYS = np.zeros((1, 2))

pytestmark = pytest.mark.usefixtures("as_python")


@pytest.mark.parametrize("seed", range(3))
def test_it_is_the_textbook_filter(seed):
    model = random_affine(seed=seed)
    inputs, measurements = simulated(model, 200, missing=0.1)
    means, covs, *_, levels, _ = run(KalmanFilter(model=model), KEYS, inputs, measurements)
    expected = kalman_filter(model, inputs[0], measurements[0])
    each_close((means[0], covs[0], levels[0]), expected, rtol=1e-10, atol=1e-10)


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
        each_close((estimates.means[0, k], estimates.covs[0, k]), (other.x[:, 0], other.P), rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(estimates.innovations[0, k], other.y[:, 0], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(estimates.innovation_covs[0, k], other.S, rtol=1e-9, atol=1e-9)


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
    each_close((a @ x + b @ u + offset, c @ x + shift), (f(x, u), h(x)), rtol=1e-12)
    for i in range(2):
        each_close((a[:, i], c[:, i]), (slope(lambda y: f(y, u), x, i), slope(h, x, i)), rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(b[:, 0], slope(lambda v: f(x, v), u, 0), rtol=1e-6, atol=1e-9)
    for name in ("process_noise_cov", "measurement_noise_cov", "prior_mean", "prior_cov"):
        np.testing.assert_array_equal(getattr(affine, name), getattr(model, name))


def test_an_affine_model_is_its_own_linearisation():
    model = random_affine()
    assert linearize(model, np.ones(3), np.ones(2)) is model


@pytest.mark.parametrize("kind", [KalmanFilter, SteadyStateKalmanFilter])
def test_a_nonlinear_model_without_an_operating_point_is_refused(kind):
    model = thruster_model().replace(operating_input=None)
    refused("operating state and input.*operating_input=None", kind, model=model)


def test_a_state_known_exactly_at_first_stays_known_through_the_first_measurement():
    model = random_affine()
    model = model.replace(prior_cov=np.zeros((3, 3)))
    inputs, measurements = simulated(model, 20)
    estimates = run(KalmanFilter(model=model), KEYS, inputs, measurements)
    each_equal((estimates.means[0, 0], estimates.covs[0, 0]), (model.prior_mean, np.zeros((3, 3))))
    expected, *_ = kalman_filter(model, inputs[0], measurements[0])
    np.testing.assert_allclose(estimates.means[0], expected, rtol=1e-10, atol=1e-10)


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
        each_close((estimates.means[0, k], estimates.covs[0, k]), (x, p), rtol=1e-10, atol=1e-10)


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


def test_a_state_known_exactly_at_first_keeps_covariances_positive():
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


def driven(model, steps=100):
    inputs = held_voltages(1, steps // 10, hold=10, seed=1, limit=30.0)
    return simulate.simulate(model, episode_keys([1]), inputs).measurements, inputs


@pytest.mark.parametrize("count", [2, 5])
def test_a_schedule_is_the_kalman_filter_of_the_model_between_the_nearest_two(count):
    model = thruster_model()
    z, inputs = driven(model)
    z[0, 5] = np.nan
    volts = np.linspace(-24.0, 24.0, count)
    states = [steady_state(make_plant().parameters, float(v))[:2] for v in volts]
    tables = [linearize(model, x, [v]).matrices() for x, v in zip(states, volts, strict=True)]

    def affine(u):
        """Each matrix by itself, linear in the voltage, constant beyond the ends."""
        stacked = [np.array([table[i] for table in tables]) for i in range(5)]
        right = int(np.clip(np.searchsorted(volts, u), 1, count - 1))
        part = np.clip((u - volts[right - 1]) / (volts[right] - volts[right - 1]), 0.0, 1.0)
        return [(1 - part) * matrix[right - 1] + part * matrix[right] for matrix in stacked]

    estimates = run(KalmanFilter(model=model, schedule=count), KEYS, inputs, z)
    x, p = model.prior_mean, model.prior_cov
    _, _, _, c, shift = affine(0.0)
    for k in range(101):
        if k > 0:
            a, b, offset, c, shift = affine(inputs[0, k - 1, 0])
            x = a @ x + b @ inputs[0, k - 1] + offset
            p = a @ p @ a.T + model.process_noise_cov
        if not np.isnan(z[0, k, 0]):
            s = c @ p @ c.T + model.measurement_noise_cov
            gain = p @ c.T / s
            x, p = x + gain @ (z[0, k] - c @ x - shift), p - gain @ c @ p
        each_close((estimates.means[0, k], estimates.covs[0, k]), (x, p), rtol=1e-9, atol=1e-9)


def test_on_the_thruster_a_schedule_is_much_better_than_the_filter_of_one_point():
    model = thruster_model()
    inputs = held_voltages(10, 20)
    drawn = simulate.simulate(model, episode_keys(range(10)), inputs)

    def rmse(filter_):
        errors = (run(filter_, np.zeros((10, 2)), inputs, drawn.measurements).means - drawn.states)[:, 50:]
        return np.sqrt(np.mean(errors**2, axis=(0, 1)))

    assert (rmse(KalmanFilter(model=model, schedule=9)) < 0.75 * rmse(KalmanFilter(model=model))).all()


def test_a_schedule_has_the_covariance_form_only():
    with pytest.raises(ValueError, match="covariance form .*form='square-root'"):
        KalmanFilter(model=thruster_model(), schedule=5, form="square-root")
