"""Extended, iterated, fading, H-infinity and Schmidt's filters against textbooks, FilterPy and one another."""

import math

import numpy as np
import pytest
from scipy.optimize import minimize

from filters import (
    ExtendedKalmanFilter,
    IteratedExtendedKalmanFilter,
    linearize,
    make_filter,
    run,
    thruster_model,
)
from tests import models
from tests.filters.attitudes import TAKE_ROTATIONS
from tests.filters.textbooks import extended_filter
from tests.models import DT, random_affine, scalar_model, simulated, state_space, swing, wide_model
from tests.oracles import each_close


def swing_jacobian(x, u, c):
    by_angle, by_rate = -DT * c[0] * math.cos(x[0]), 1.0 - 2.0 * DT * c[1] * abs(x[1])
    return ((1.0 + DT * by_angle, DT * by_rate), (by_angle, by_rate))


def look_jacobian(x, c):
    return ((math.cos(x[0]), 0.0), (x[1], x[0]))


def pendulum(analytic=True, **changes):
    """The pendulum, with its Jacobians or without."""
    given = {"transition_jacobian": swing_jacobian, "observe_jacobian": look_jacobian} if analytic else {}
    return models.pendulum(**{**given, **changes})


def estimates_of(model, inputs, measurements, kind=ExtendedKalmanFilter):
    return run(kind(model=model), np.zeros((1, 2)), inputs, measurements)


def test_it_is_the_textbook_filter():
    inputs, measurements = simulated(pendulum(), 150)
    estimates = estimates_of(pendulum(), inputs, measurements)
    expected = extended_filter(pendulum(), inputs[0], measurements[0])
    each_close([part[0] for part in estimates[:4]], expected, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("x", [(0.0, 0.0), (0.5, -2.0), (-3.0, 100.0), (30.0, 0.02)])
def test_central_differences_agree_with_the_analytic_jacobian(x):
    c = pendulum().constants
    a, b, _, h, _ = linearize(pendulum(analytic=False), x, (1.5,)).matrices()
    np.testing.assert_allclose(a, swing_jacobian(x, (1.5,), c), rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(b, [[DT * DT], [DT]], rtol=1e-7)
    np.testing.assert_allclose(h, look_jacobian(x, c), rtol=1e-7, atol=1e-7)


def test_without_jacobians_the_estimates_are_the_same_to_the_differences_accuracy():
    inputs, measurements = simulated(pendulum(), 150)
    analytic = estimates_of(pendulum(), inputs, measurements)
    numeric = estimates_of(pendulum(analytic=False), inputs, measurements)
    np.testing.assert_allclose(numeric.means, analytic.means, rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(numeric.covs, analytic.covs, rtol=1e-7, atol=1e-9)


def swing_thrice(x, u, c):
    return swing(swing(swing(x, u, c), u, c), u, c)


@pytest.mark.parametrize("analytic", [True, False])
def test_substeps_compose_the_transition_and_chain_its_jacobian(analytic):
    inputs, measurements = simulated(pendulum(substeps=3), 150)
    whole = estimates_of(pendulum(analytic=False, transition=swing_thrice), inputs, measurements)
    parts = estimates_of(pendulum(analytic=analytic, substeps=3), inputs, measurements)
    np.testing.assert_allclose(parts.means, whole.means, rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(parts.covs, whole.covs, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("preset", ["tunnel", "tunnel_physical", "open_bladed_corrected"])
@pytest.mark.parametrize("x", [(80.0, 1.2), (-40.0, 0.9), (3.0, -2.0)])
def test_the_thruster_s_jacobians_are_those_of_its_functions(preset, x):
    model = thruster_model(preset=preset, ambient_velocity=0.3)
    c, u, step = model.constants, (7.0,), 1e-5
    by_state, by_thrust = [], []
    for dx in ((step, 0.0), (0.0, step)):
        above, below = (x[0] + dx[0], x[1] + dx[1]), (x[0] - dx[0], x[1] - dx[1])
        moved = np.subtract(model.transition(above, u, c), model.transition(below, u, c))
        by_state.append(moved / (2 * step))
        by_thrust.append((model.observe(above, c)[0] - model.observe(below, c)[0]) / (2 * step))
    np.testing.assert_allclose(model.transition_jacobian(x, u, c), np.transpose(by_state), rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(model.observe_jacobian(x, c), [by_thrust], rtol=1e-6, atol=1e-6)


AT_LIMITS = {name: numbers for name, (numbers, kin, _) in TAKE_ROTATIONS.items() if kin == "ekf"}


@pytest.mark.parametrize("name", AT_LIMITS)
@pytest.mark.parametrize("make", [wide_model, thruster_model])
def test_parameters_at_their_limits_make_the_extended_filter(name, make):
    model = make()
    inputs, z = simulated(model, 40, level=1.0, missing=0.2)
    filters = make_filter(name, model, **AT_LIMITS[name]), make_filter("ekf", model)
    each_close(*(run(filter_, None, inputs, z) for filter_ in filters), rtol=1e-8, atol=1e-8)


KEYS = np.zeros((1, 2))

pytestmark = pytest.mark.usefixtures("as_python")


def stay(x, u, c):
    return (x[0], x[1])


def see_landmark(x, c):
    return (math.sqrt(x[0] * x[0] + x[1] * x[1]), math.atan2(x[1], x[0]))


def landmark_slopes(x, c):
    square = x[0] * x[0] + x[1] * x[1]
    distance = math.sqrt(square)
    return ((x[0] / distance, x[1] / distance), (-x[1] / square, x[0] / square))


def landmark(**changes):
    """A place in the plane, seen by distance and bearing."""
    noise = {"q": [0.01, 0.01], "r": [[0.05, 0.01], [0.01, 0.02]]}
    prior = {"mean": [3.0, 2.0], "cov": [[2.0, 0.4], [0.4, 1.0]]}
    return state_space(stay, see_landmark, **noise, **prior, **{"observe_jacobian": landmark_slopes, **changes})


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
        h = np.array(landmark_slopes(x, ()))
        slope = h.T @ weight_r @ (z - see_landmark(x, ())) + weight_p @ (mean - x)
        x = x + np.linalg.solve(weight_p + h.T @ weight_r @ h, slope)
    np.testing.assert_allclose(updated.mean, x, rtol=1e-10)
    np.testing.assert_allclose(updated.cov, np.linalg.inv(weight_p + h.T @ weight_r @ h), rtol=1e-10)
    first = np.array(landmark_slopes(mean, ()))
    each_close(
        (innovation.value, innovation.cov), (z - see_landmark(mean, ()), first @ p @ first.T + r), rtol=1e-12
    )


def test_many_iterations_find_the_most_probable_state():
    model, z = landmark(), np.array([2.0, 1.2])
    weight_p, weight_r = np.linalg.inv(model.prior_cov), np.linalg.inv(model.measurement_noise_cov)

    def misfit(x):
        e, d = z - see_landmark(x, ()), x - model.prior_mean
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
        observe=lambda x, c: (see_landmark(x, c)[0],),
        observe_jacobian=lambda x, c: (landmark_slopes(x, c)[0],),
        measurement_noise_cov=[0.05],
    )
    found, innovation = IteratedExtendedKalmanFilter(model=both).update(
        IteratedExtendedKalmanFilter(model=both).init(), [2.5, np.nan]
    )
    expected, alone = IteratedExtendedKalmanFilter(model=one).update(
        IteratedExtendedKalmanFilter(model=one).init(), [2.5]
    )
    each_close((found.mean, found.cov), (expected.mean, expected.cov), rtol=1e-12)
    assert innovation.value[1] == 0.0
    assert innovation.log_likelihood == pytest.approx(alone.log_likelihood, rel=1e-12)


NO_MORE = {"fading": {"fading": 1.0}, "h-infinity": {"theta": 1e-12}, "schmidt": {}}


def naive(model, inputs, z, correct, fading=1.0):
    """Means and covariances of a linear filter: correct(x, P, v, H) after each prediction."""
    a, b, offset, c, shift = model.matrices()
    x, p, found = np.array(model.prior_mean), model.prior_cov, []
    for k, seen in enumerate(z):
        if k:
            x = a @ x + b @ inputs[k - 1] + offset
            p = fading**2 * a @ p @ a.T + model.process_noise_cov
        x, p = correct(x, p, seen - c @ x - shift, c)
        found.append((x, p))
    return [np.array(one) for one in zip(*found, strict=True)]


@pytest.mark.parametrize("name", NO_MORE)
def test_equals_the_textbook(name):
    model = random_affine()
    inputs, z = simulated(model, 30)
    prior = model.prior_cov
    r, scale, theta = model.measurement_noise_cov, np.array([1.0, 2.0, 4.0]), 0.05

    def of_kalman(x, p, v, h):
        k = p @ h.T @ np.linalg.inv(h @ p @ h.T + r)
        return x + k @ v, (np.eye(3) - k @ h) @ p

    def of_game(x, p, v, h):  # Simon, eq. (11.89); the prior is taken as it is
        bound = 0.0 if p is prior else theta
        inner = np.eye(3) - bound * np.diag(scale**-2.0) @ p + h.T @ np.linalg.inv(r) @ h @ p
        p = p @ np.linalg.inv(inner)
        return x + p @ h.T @ np.linalg.inv(r) @ v, p

    def considered(x, p, v, h):  # Simon, section 10.1: the last state is considered, in blocks
        s = h @ p @ h.T + r
        k = (p @ h.T @ np.linalg.inv(s))[:2]
        estimated = p[:2, :2] - k @ (h @ p)[:, :2]
        crossed = p[:2, 2:] - k @ (h @ p)[:, 2:]
        return x + np.append(k @ v, 0.0), np.block([[estimated, crossed], [crossed.T, p[2:, 2:]]])

    cases = {
        "fading": ({"fading": 1.05}, of_kalman, 1.05),
        "h-infinity": ({"theta": theta, "scale": scale}, of_game, 1.0),
        "schmidt": ({"considered": [-1]}, considered, 1.0),
    }
    numbers, correct, fading = cases[name]
    found = run(make_filter(name, model, **numbers), None, inputs, z)
    means, covs = naive(model, inputs[0], z[0], correct, fading)
    np.testing.assert_allclose(found.means[0], means, rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(found.covs[0], covs, rtol=1e-9, atol=1e-12)
    plain = run(make_filter("ekf", model), None, inputs, z)
    assert abs(plain.means - found.means).max() > 0.01  # the numbers matter


def test_fading_equals_the_filter_of_filterpy():
    filterpy = pytest.importorskip("filterpy.kalman")
    model = random_affine(2, 1, 1)
    a, b, _, c, _ = model.replace(prior_mean=np.zeros(2)).matrices()
    inputs, z = np.zeros((1, 25, 1)), np.random.default_rng(3).normal(size=(1, 26, 1))
    other = filterpy.FadingKalmanFilter(alpha=1.1, dim_x=2, dim_z=1)
    other.F, other.H, other.Q = a, c, np.array(model.process_noise_cov)
    other.R, other.P = np.array(model.measurement_noise_cov), np.array(model.prior_cov)
    flat = model.replace(prior_mean=np.zeros(2))
    ours = make_filter("fading", flat, fading=1.1)
    offset, shift = model.matrices()[2], model.matrices()[4]
    belief, other.x = ours.init(), np.zeros((2, 1))
    for k in range(25):
        belief, _ = ours.update(ours.predict(belief, inputs[0, k]), z[0, k])
        other.predict()
        other.x += offset[:, None]
        other.update(z[0, k][:, None] - shift[:, None])
        np.testing.assert_allclose(belief.mean, other.x[:, 0], rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(belief.cov, other.P, rtol=1e-10)


def test_the_steady_state_of_a_scalar_game():
    """With F = H = Q = R = 1 Simon's example has P = 1 + P/(1 + (1 - theta) P), as predicted."""
    theta = 1.0 / 3.0
    model = scalar_model(a=[[1.0]], c=[[1.0]], process_noise_cov=[1.0], measurement_noise_cov=[1.0])
    filter_ = make_filter("h-infinity", model, theta=theta, scale=[1.0])
    belief = filter_.init()
    for _ in range(200):
        belief = filter_.predict(filter_.update(belief, [0.0])[0], np.zeros(model.inputs))
    before = 1.0 / (1.0 / belief.cov[0, 0] + theta)  # theta acts at the end of a prediction here
    assert before == pytest.approx((1.0 + np.sqrt(7.0)) / 2.0, rel=1e-12)


def test_a_bound_that_nothing_keeps_is_a_divergence():
    model = scalar_model()
    filter_ = make_filter("h-infinity", model, theta=100.0, scale=[0.1])
    belief, _ = filter_.update(filter_.predict(filter_.init(), [0.0]), [0.0])
    assert belief.divergences == 1
