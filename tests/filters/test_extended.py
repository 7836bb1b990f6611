"""The extended Kalman filter against a textbook one, its derivatives, and its consistency on the thruster."""

import math

import numpy as np
import pytest

from filters import ExtendedKalmanFilter, linearize, make_filter, run, thruster_model
from tests import models
from tests.filters.test_attitude import TAKE_ROTATIONS
from tests.models import DT, look, simulated, swing, wide_model
from tests.oracles import each_close, kalman_update
from thruster_env.core.compiled import interpreted


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
    with interpreted():
        return run(kind(model=model), np.zeros((1, 2)), inputs, measurements)


def test_it_is_the_textbook_filter():
    model = pendulum()
    inputs, measurements = simulated(model, 150)
    estimates = estimates_of(model, inputs, measurements)
    q, r, c = model.process_noise_cov, model.measurement_noise_cov, model.constants
    x, p = model.prior_mean, model.prior_cov
    for k, z in enumerate(measurements[0]):
        if k > 0:
            f = np.array(swing_jacobian(x, inputs[0, k - 1], c))  # at the last estimate, before it moves
            x = np.array(swing(x, inputs[0, k - 1], c))
            p = f @ p @ f.T + q
        h = np.array(look_jacobian(x, c))
        innovation = z - np.array(look(x, c))
        x, p, s = kalman_update(x, p, innovation, h, r)
        np.testing.assert_allclose(estimates.means[0, k], x, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(estimates.covs[0, k], p, rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(estimates.innovations[0, k], innovation, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(estimates.innovation_covs[0, k], s, rtol=1e-10, atol=1e-12)


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
@pytest.mark.usefixtures("as_python")
def test_parameters_at_their_limits_make_the_extended_filter(name, make):
    model = make()
    inputs, z = simulated(model, 40, level=1.0, missing=0.2)
    filters = make_filter(name, model, **AT_LIMITS[name]), make_filter("ekf", model)
    each_close(*(run(filter_, None, inputs, z) for filter_ in filters), rtol=1e-8, atol=1e-8)
